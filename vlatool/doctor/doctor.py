"""What is in order on this machine, what is missing, and the command that fixes it.

Every check takes the root of the file system, or what was found, and returns ``Check`` values; nothing is changed.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from vlatool import registry
from vlatool.errors import GraphError, MissingExtra, PluginError, VlatoolError, pip_install
from vlatool.files.printable import message_of
from vlatool.machine import host
from vlatool.runtime.arithmetic import EXACT
from vlatool.runtime.engine import DEFAULT_ENGINE, Engine, usable_engines
from vlatool.stage.products import int8_arithmetic
from vlatool.telemetry.rapl import UDEV_RULE

Status = Literal["ok", "warn", "missing"]

EXTRAS: Mapping[str, tuple[str, ...]] = {
    "ort": ("onnxruntime",),
    "cuda": ("onnxruntime-gpu",),
    "build": ("torch", "onnx", "onnxscript", "onnx-ir", "safetensors"),
    "openvino": ("openvino",),
    "data": ("pillow", "pyarrow", "av", "h5py", "zarr", "rosbags", "google-crc32c"),
    "bags": ("rosbags",),
    "sim": ("gymnasium", "minigrid"),
    "metaworld": ("metaworld", "mujoco"),
    "text": ("tokenizers",),
    "sign": ("cryptography",),
    "remote": ("websockets", "msgpack"),
    "serve": ("websockets", "msgpack", "grpcio", "pyzmq"),
    "dds": ("cyclonedds",),
    "worlds": ("mujoco",),
    "zenoh": ("eclipse-zenoh",),
    "search": ("optuna",),
    "tensorboard": ("tensorboard",),
    "video": ("pillow",),
    "mp4": ("pillow", "imageio-ffmpeg"),
    "ray": ("ray",),
    "dev": ("pytest", "pytest-cov", "ruff", "mypy", "import-linter"),
}
"""Extra -> the distributions that it installs, as in ``pyproject.toml``."""
PYTHON = (3, 10)
FREE_GB = 5.0
"""Below this a build (export, several candidates, reports) of a 0.5 GB policy runs out of disk."""
MEMORY_GB = 2.0
COMPARE_INT8 = "compare int8 with float32 on this machine"
INT8_FEATURES = {
    "amx_int8": "AMX: int8 is computed in tiles, many times faster than float32; use uint8 activations",
    "avx512_vnni": "AVX-512 VNNI: int8 is up to 4 times as fast as float32; use uint8 activations",
    "avx_vnni": "AVX-VNNI: int8 is up to 4 times as fast as float32; use uint8 activations",
    "i8mm": "i8mm: int8 matrix instructions, up to 8 times float32; use int8 activations",
    "asimddp": "dot product (asimddp): int8 is up to 4 times as fast as float32; use int8 activations",
}
"""Features of processors with int8 instructions, the fastest first -> what they mean."""


@dataclass(frozen=True)
class Check:
    """One finding.

    Args:
        name: what was looked at.
        status: ``ok``, ``warn`` (works, but) or ``missing``.
        finding: what was found, in words.
        fix: what to do; empty when nothing is to be done.
    """

    name: str
    status: Status
    finding: str
    fix: str = ""


def diagnose(root: Path = host.ROOT) -> list[Check]:
    """Look at Python, engines, extras, instruction set, telemetry, clocks, cores, memory and disk.

    Example:
        >>> [check.name for check in diagnose()][0]
        'python'
    """
    engines_of = (library.distributions() for library in usable_engines().values())
    installed = host.versions({*chain(*EXTRAS.values(), *engines_of)})
    return [
        python_version(),
        *engines(installed, host.board(root), lambda library: library.execution_providers()),
        *arithmetic(),
        *extras(installed),
        *plugins(),
        instruction_set(host.isa(root)),
        *onednn_limit(host.onednn_max_cpu_isa()),
        *telemetry(root),
        clocks(root),
        cores(root),
        memory(root),
        disk(root),
    ]


def python_version(version: tuple[int, ...] = sys.version_info[:3]) -> Check:
    """Python is new enough."""
    running = ".".join(str(part) for part in version)
    if version < PYTHON:
        needed = ".".join(str(part) for part in PYTHON)
        return Check(
            "python", "missing", f"Python {running}; vlatool needs {needed}", f"install Python {needed} or later"
        )
    return Check("python", "ok", f"Python {running}")


def engines(
    installed: Mapping[str, str], board: str | None, ask: Callable[[type[Engine]], list[str] | None]
) -> Iterator[Check]:
    """The inference libraries with their version and, where they say so, what they run on."""
    jetson = bool(board and "jetson" in board.lower())
    packages: set[str] = set()
    for name, library in usable_engines().items():
        title = f"engine {name if library.package in packages else library.package}"
        packages.add(library.package)
        package = next((name for name in library.distributions() if name in installed), None)
        if package is not None and library.is_installed():
            yield _engine(title, f"{package} {installed[package]}", library, jetson, ask)
            continue
        advice = f" ({library.advice})" if library.advice else ""
        if package is not None:
            yield Check(title, "missing", "this machine lacks the device, or its driver", library.advice)
            continue
        fix = "" if jetson and advice else f"{library.installation()}{advice}"
        yield Check(title, "missing", "not installed", fix)


def _engine(
    title: str, words: str, library: type[Engine], jetson: bool, ask: Callable[[type[Engine]], list[str] | None]
) -> Check:
    try:
        providers = ask(library)
    except MissingExtra as error:
        return Check(title, "warn", f"{words} is installed, but cannot be used: {error.message}", error.fix)
    except Exception as error:  # the seam: a library, or another package's engine, may raise anything
        return Check(title, "warn", f"{words} fails: {type(error).__name__}: {message_of(error)}", "update it")
    if providers is None:
        return Check(title, "ok", words)
    short = [name.removesuffix("ExecutionProvider") for name in providers]
    finding = f"{words}: {', '.join(short) or 'no provider'}"
    if jetson and not {"CUDA", "Tensorrt"} & {*short}:
        fix = "install the onnxruntime-gpu wheel of NVIDIA's Jetson index for your JetPack; the plain wheel has no GPU"
        return Check(title, "warn", f"{finding}; this board's GPU stays idle", fix)
    return Check(title, "ok" if short else "warn", finding, "" if short else "reinstall it")


def arithmetic() -> Iterator[Check]:
    """How each engine that is installed computes int8 products on this processor: measured, not looked up."""
    for name, library in usable_engines().items():
        if not library.is_installed():
            continue
        try:
            products = int8_arithmetic(name)
        except GraphError as error:  # the engine ended its process, or hangs
            yield Check(f"int8 {name}", "warn", error.message, error.fix)
            continue
        except VlatoolError:
            continue
        finding = f"products of uint8 and int8 are {products}"
        if products == EXACT:
            yield Check(f"int8 {name}", "ok", finding)
            continue
        fix = COMPARE_INT8
        if name != DEFAULT_ENGINE and library.layouts:
            fix = "vlatool quantize static-int8 SOURCE -o BUNDLE --layout ort: ONNX Runtime is set to be exact here; "
            fix += f"or --layout {name} --reduce-range"
        yield Check(f"int8 {name}", "warn", finding, fix)


def extras(installed: Mapping[str, str]) -> Iterator[Check]:
    """Which optional parts of vlatool can be used."""
    for extra, packages in EXTRAS.items():
        absent = [name for name in packages if _present(name, installed) is None]
        if absent:
            yield Check(f"extra {extra}", "missing", f"lacks {', '.join(absent)}", pip_install(extra))
        else:
            versions = ", ".join(f"{name} {installed[_present(name, installed) or name]}" for name in packages)
            yield Check(f"extra {extra}", "ok", versions)


def _present(name: str, installed: Mapping[str, str]) -> str | None:
    """The distribution that provides ``name``, or None."""
    return next((package for package in (name, *_substitutes().get(name, ())) if package in installed), None)


def plugins() -> Iterator[Check]:
    """What other packages add to vlatool."""
    for title, added in registry.all_plugins().items():
        name, broken = f"plugin {title.partition(' ')[0]}", []
        for entry in added:
            try:
                registry.module(*entry.split(".", 1))
            except PluginError as error:
                broken.append(error.message)
        finding = "; ".join([f"{title} adds {', '.join(added)}", *broken])
        yield Check(name, "warn", finding, "update it") if broken else Check(name, "ok", finding)


def _substitutes() -> dict[str, tuple[str, ...]]:
    """Package of an engine -> the distributions of other names that bring it."""
    known: dict[str, tuple[str, ...]] = {}
    for library in usable_engines().values():
        known[library.package] = (*known.get(library.package, ()), *library.substitutes)
    return known


def instruction_set(features: Sequence[str] | None) -> Check:
    """Whether the processor multiplies int8 natively, and what that means."""
    name = "int8"
    if features is None:
        return Check(name, "warn", "the processor's features cannot be read", COMPARE_INT8)
    fastest = next((feature for feature in INT8_FEATURES if feature in features), None)
    if fastest is not None:
        return Check(name, "ok", INT8_FEATURES[fastest])
    if "avx2" in features:
        finding = "AVX2 without VNNI: int8 is at best twice as fast as float32, and 8-bit weights saturate in "
        finding += "OpenVINO; ONNX Runtime is set to be exact, which is slower"
        fix = "quantize with --layout ort, or with --reduce-range, and measure it; or stay with float32"
        return Check(name, "warn", finding, fix)
    finding = "no int8 dot product: int8 saves memory here, but may be slower than float32"
    return Check(name, "warn", finding, "measure before you ship int8")


def onednn_limit(isa: str | None) -> Iterator[Check]:
    """Whether a variable keeps OpenVINO from instructions that the processor has."""
    if isa is not None:
        setting = f"{host.MAX_CPU_ISA}={isa}"
        finding = f"{setting} confines OpenVINO to older instructions: it is slower and may round differently"
        yield Check("oneDNN", "warn", finding, f"unset {host.MAX_CPU_ISA}, unless you mean to try another processor")


def telemetry(root: Path = host.ROOT) -> Iterator[Check]:
    """Where power and temperature can be read."""
    checks = [*_rapl(root), *_ina3221(root), *_vcgencmd(root)]
    if not checks:
        finding = "no RAPL, INA3221 or vcgencmd: power is reported as unmeasured"
        checks = [Check("power", "missing", finding, "measure at the wall, or on the board itself")]
    yield from checks
    folders = _glob(root, "sys/class/thermal", "thermal_zone*")
    zones = [host.read_text(root, f"{folder.relative_to(root)}/type") for folder in folders]
    if zones:
        yield Check("temperature", "ok", f"{len(zones)} thermal zones: {', '.join(dict.fromkeys(filter(None, zones)))}")
    else:
        finding = "no thermal zone: throttling cannot be seen"
        yield Check("temperature", "missing", finding, "measure on the board itself")


def _glob(root: Path, folder: str, pattern: str) -> list[Path]:
    return sorted((root / folder).glob(pattern))


def _rapl(root: Path) -> Iterator[Check]:
    counters = _glob(root, "sys/class/powercap", "intel-rapl:*/energy_uj")
    if not counters:
        return
    if any(_readable(counter) for counter in counters):
        finding = "the energy counter of the processor package can be read; it leaves out the board"
        yield Check("power RAPL", "ok", finding)
    else:
        fix = f"as root, write into a udev rule, with your group for GROUP: {UDEV_RULE}"
        yield Check("power RAPL", "warn", "the energy counter is there, but only root may read it", fix)


def _readable(path: Path) -> bool:
    try:
        return bool(path.read_bytes())
    except OSError:
        return False


def _ina3221(root: Path) -> Iterator[Check]:
    for monitor in _glob(root, "sys/class/hwmon", "hwmon*"):
        path = monitor.relative_to(root).as_posix()
        if host.read_text(root, f"{path}/name") == "ina3221":
            labels = [host.read_text(root, f"{path}/in{channel}_label") for channel in (1, 2, 3)]
            rails = [label for label in labels if label and label != "NC"]
            whole = "VDD_IN is the whole module" if "VDD_IN" in rails else "no rail is the whole module"
            yield Check("power INA3221", "ok", f"rails {', '.join(rails) or 'without label'}; {whole}")


def _vcgencmd(root: Path) -> Iterator[Check]:
    if not any((root / folder / "vcgencmd").exists() for folder in ("usr/bin", "opt/vc/bin")):
        return
    if (root / "dev/vcio").exists() and os.access(root / "dev/vcio", os.R_OK | os.W_OK):
        yield Check("power vcgencmd", "ok", "throttling and supply voltage can be read")
    else:
        fix = "sudo usermod -aG video $USER, then log in again"
        yield Check("power vcgencmd", "warn", "vcgencmd is there, but its device cannot be opened", fix)


def clocks(root: Path = host.ROOT) -> Check:
    """Whether the clocks are held, so that two runs compare."""
    frequency = host.frequency(root)
    governor, model = frequency["governor"], host.board(root) or ""
    if governor is None:
        finding = "no frequency policy is visible (a virtual machine or container); clocks cannot be checked"
        return Check("clocks", "warn", finding, "repeat measurements and interleave what you compare")
    if governor == "performance":
        return Check("clocks", "ok", "governor performance")
    fix = "sudo cpupower frequency-set -g performance"
    if "jetson" in model.lower():
        fix = "sudo nvpmodel -m MODE && sudo jetson_clocks; write the mode beside the result"
    elif "raspberry" in model.lower():
        fix = "echo performance | sudo tee /sys/devices/system/cpu/cpufreq/policy*/scaling_governor"
    return Check("clocks", "warn", f"governor {governor}: clocks follow the load, latency varies with them", fix)


def cores(root: Path = host.ROOT) -> Check:
    """How many cores this process gets."""
    usable, online, quota = host.usable_cores(root), host.online_cores(root), host.cpu_quota(root)
    if usable is None:
        return Check("cores", "warn", "the number of usable cores cannot be read")
    finding = f"{usable} of {online} logical cores" if online else f"{usable} logical cores"
    if quota is not None and quota < usable:
        fix = "raise the container's CPU limit, or run with that many threads"
        return Check("cores", "warn", f"{finding}, limited to {quota:g} by a control group", fix)
    if online and usable < online:
        return Check("cores", "warn", f"{finding}: an affinity mask keeps this process off the others")
    return Check("cores", "ok", finding)


def memory(root: Path = host.ROOT) -> Check:
    """How much memory this process may take."""
    sizes = host.memory(root)
    available, limit = sizes["memory_available_mb"], sizes["memory_limit_mb"]
    known = [value for value in (available, limit) if value is not None]
    if not known:
        return Check("memory", "warn", "the amount of memory cannot be read")
    parts = [] if available is None else [f"{available / 1e3:.1f} GB available"]
    parts += [] if limit is None else [f"a control group's limit of {limit / 1e3:.1f} GB"]
    low = min(known) < MEMORY_GB * 1e3
    fix = "close other programs (a desktop takes about 0.5 GB), or add swap to build"
    return Check("memory", "warn" if low else "ok", " and ".join(parts), fix if low else "")


def disk(root: Path = host.ROOT, usage: Callable[[Path], Any] = shutil.disk_usage) -> Check:
    """How much disk is free in the current directory (below another root: there)."""
    free_gb = usage(Path.cwd() if root == host.ROOT else root).free / 1e9
    if free_gb < FREE_GB:
        return Check("disk", "warn", f"{free_gb:.1f} GB free", f"free {FREE_GB:g} GB, or write the output elsewhere")
    return Check("disk", "ok", f"{free_gb:.1f} GB free")
