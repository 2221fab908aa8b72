"""What this machine is and how it is set: the fingerprint that goes into every report.

Standard library only. Every reader takes the root of the file system, so that a copied tree can be read; what is absent
is None, never 0. Nothing here names the host, a user or a path: reports are shared.
"""

from __future__ import annotations

import os
import platform
import re
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vlatool.machine.version import VERSION

ROOT = Path("/")
DISTRIBUTIONS = (
    "numpy",
    "onnxruntime",
    "onnxruntime-gpu",
    "onnxruntime-openvino",
    "openvino",
    "torch",
    "onnx",
    "onnx-ir",
    "tensorrt",
)
ISA_FEATURES = (
    *("avx2", "fma", "f16c", "avx_vnni", "avx_vnni_int8", "avx512f", "avx512_vnni", "avx512_bf16", "avx512_fp16"),
    *("amx_tile", "amx_int8", "amx_bf16"),
    *("asimd", "asimdhp", "asimddp", "i8mm", "bf16", "sve", "sve2"),
)
"""Names of ``/proc/cpuinfo`` that decide how fast a network runs."""
VNNI = ("amx_int8", "avx512_vnni", "avx_vnni_int8", "avx_vnni")
"""Features with which int8 products are exact, and faster than float32."""
LEROBOT_PYTHON = "VLATOOL_LEROBOT_PYTHON"
"""Variable that names the Python that has LeRobot, in which checkpoints of it are traced; ``--python`` sets it."""
UNNORM_KEY = "VLATOOL_UNNORM_KEY"
"""Variable that says which statistics of a checkpoint of several datasets its actions are in; ``--unnorm-key``."""
MAX_CPU_ISA = "ONEDNN_MAX_CPU_ISA"
"""The variable that confines oneDNN, and so OpenVINO, to an instruction set; read once, when it is loaded."""
OLDER_MAX_CPU_ISA = "DNNL_MAX_CPU_ISA"
ARM_CORES = {
    ("0x41", "0xd03"): "Cortex-A53",
    ("0x41", "0xd05"): "Cortex-A55",
    ("0x41", "0xd07"): "Cortex-A57",
    ("0x41", "0xd08"): "Cortex-A72",
    ("0x41", "0xd0b"): "Cortex-A76",
    ("0x41", "0xd41"): "Cortex-A78",
    ("0x41", "0xd42"): "Cortex-A78AE",
    ("0x41", "0xd0c"): "Neoverse-N1",
    ("0x41", "0xd40"): "Neoverse-V1",
    ("0x41", "0xd4f"): "Neoverse-V2",
    ("0x41", "0xd83"): "Neoverse-V3AE",
    ("0x4e", "0x004"): "Carmel",
}
"""(Implementer, part) of ``/proc/cpuinfo`` -> core; from ``arch/arm64/include/asm/cputype.h`` of Linux."""
NO_LIMIT_BYTES = 1 << 60
"""A memory limit of cgroup v1 from here on means that there is none."""


def fingerprint(root: Path = ROOT) -> dict[str, Any]:
    """Return what a reader of a benchmark must know about the machine, as plain JSON values.

    ``cores`` counts those that this process may use; ``cpu_quota`` is the limit of the container in cores. Memory is in
    MB (10^6 bytes), clocks in MHz.

    Example:
        >>> fingerprint()["architecture"] in ("x86_64", "aarch64", "arm64", None)
        True
    """
    load = read_text(root, "proc/loadavg")
    return {
        "cpu": cpu_model(root),
        "architecture": architecture(root),
        "board": board(root),
        "isa": isa(root),
        "onednn_max_cpu_isa": onednn_max_cpu_isa(),
        "cores": usable_cores(root),
        "cores_online": online_cores(root),
        "cpu_quota": cpu_quota(root),
        **memory(root),
        **frequency(root),
        "load_average": [float(part) for part in load.split()[:3]] if load else None,
        "kernel": read_text(root, "proc/sys/kernel/osrelease"),
        "os": os_name(root),
        "container": container(root),
        "virtual_machine": virtual_machine(root),
        "python": platform.python_version(),
        "versions": {"vlatool": VERSION, **versions()},
    }


def matches(model_strings: Iterable[str], machine: Mapping[str, Any]) -> bool:
    """Say whether a fingerprint is that of a board that goes by one of these strings (board or processor model)."""
    names = " | ".join(str(machine.get(key) or "") for key in ("board", "cpu")).lower()
    return any(model.lower() in names for model in model_strings)


def read_text(root: Path, path: str) -> str | None:
    """Return a small file below ``root`` without surrounding blanks and NULs; None when it is absent or unreadable."""
    try:
        text = (root / path).read_bytes().decode("utf-8", "replace").strip("\0 \t\r\n")
    except OSError:
        return None
    return text or None


def read_number(root: Path, path: str) -> int | None:
    """Return a file that holds one whole number; None when there is none."""
    text = read_text(root, path)
    return int(text) if text is not None and re.fullmatch(r"-?\d+", text) else None


def cpu_model(root: Path = ROOT) -> str | None:
    """Model of the processor; on ARM its kinds of cores with their number."""
    text = read_text(root, "proc/cpuinfo") or ""
    if match := re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE):
        return " ".join(match[1].split())
    parts = re.findall(r"^CPU implementer\s*:\s*(\S+)[\s\S]*?^CPU part\s*:\s*(\S+)", text, re.MULTILINE)
    kinds = [ARM_CORES.get((maker, part), f"ARM {maker}/{part}") for maker, part in parts]
    return " + ".join(f"{kinds.count(kind)}x {kind}" for kind in dict.fromkeys(kinds)) or None


def architecture(root: Path = ROOT) -> str | None:
    """``x86_64``, ``aarch64`` or what the kernel says."""
    if kernel := read_text(root, "proc/sys/kernel/arch"):
        return kernel
    text = read_text(root, "proc/cpuinfo") or ""
    if re.search(r"^flags\s*:.*\blm\b", text, re.MULTILINE):
        return "x86_64"
    if re.search(r"^Features\s*:.*\basimd\b", text, re.MULTILINE):
        return "aarch64"
    return platform.machine() or None if root == ROOT else None


def isa(root: Path = ROOT) -> list[str] | None:
    """Instruction set features that matter for networks and that every core has."""
    text = read_text(root, "proc/cpuinfo") or ""
    lines = re.findall(r"^(?:flags|Features)\s*:\s*(.*)$", text, re.MULTILINE)
    if not lines:
        return None
    everywhere = set.intersection(*(set(line.split()) for line in lines))
    return [feature for feature in ISA_FEATURES if feature in everywhere]


def onednn_max_cpu_isa(variables: Mapping[str, str] = os.environ) -> str | None:
    """The instruction set that ``ONEDNN_MAX_CPU_ISA`` confines oneDNN, and so OpenVINO, to; None when there is none.

    oneDNN obeys the older name where the newer one is not set, takes small letters for large ones, and ``ALL`` and
    ``DEFAULT`` confine it to nothing. Anything else is reported as ``?``: it may be anything, and
    reports are shared.
    """
    value = (variables.get(MAX_CPU_ISA) or variables.get(OLDER_MAX_CPU_ISA, "")).upper()
    if value in ("", "ALL", "DEFAULT"):
        return None
    return value if re.fullmatch(r"[A-Z0-9_]{1,32}", value) else "?"


def board(root: Path = ROOT) -> str | None:
    """Model of the board: device tree on ARM, vendor and product of the firmware on a PC."""
    if model := read_text(root, "proc/device-tree/model"):
        return model
    parts = [read_text(root, f"sys/class/dmi/id/{name}") for name in ("sys_vendor", "product_name")]
    return " ".join(part for part in parts if part) or None


def gpus(root: Path = ROOT) -> tuple[str, ...]:
    """Models of NVIDIA's graphics cards, as their driver names them."""
    files = sorted(path.relative_to(root) for path in (root / "proc/driver/nvidia/gpus").glob("*/information"))
    models = (re.search(r"^Model:\s*(.+)$", read_text(root, str(path)) or "", re.MULTILINE) for path in files)
    return tuple(match[1] for match in models if match)


def intel_devices(kind: str, root: Path = ROOT) -> list[str]:
    """Return Intel's devices, as the kernel names them; the kind is ``drm/renderD*`` (graphics) or ``accel/accel*``."""
    files = sorted((root / "sys/class").glob(f"{kind}/device/vendor"))
    return [path.parts[-3] for path in files if read_text(root, path.relative_to(root).as_posix()) == "0x8086"]


def gpu_driver(root: Path = ROOT) -> str | None:
    """Version of NVIDIA's driver in the kernel; None when it is not loaded."""
    match = re.search(r"^NVRM version:.*?\s(\d+\.\d[\d.]*)\s", read_text(root, "proc/driver/nvidia/version") or "")
    return f"NVIDIA driver {match[1]}" if match else None


def power_mode(root: Path = ROOT) -> str:
    """Return how the machine is set to spend power, in words; empty where nothing tells.

    On a Jetson that is the mode of ``nvpmodel``, which its service notes in ``/var/lib/nvpmodel/status``
    (``pmode:0002``) and ``/etc/nvpmodel.conf`` names; elsewhere the governor of the clocks and the profile of the
    firmware (``/sys/firmware/acpi/platform_profile``).
    """
    parts = []
    if status := re.search(r"pmode:0*(\d+)", read_text(root, "var/lib/nvpmodel/status") or ""):
        names = read_text(root, "etc/nvpmodel.conf") or ""
        name = re.search(rf"<\s*POWER_MODEL\s+ID={status[1]}\s+NAME=(\S+)\s*>", names)
        parts.append(f"nvpmodel {name[1] if name else status[1]}")
    if governor := frequency(root)["governor"]:
        parts.append(f"governor {governor}")
    if firmware := read_text(root, "sys/firmware/acpi/platform_profile"):
        parts.append(f"platform profile {firmware}")
    return ", ".join(parts)


def online_cores(root: Path = ROOT) -> int | None:
    """Logical cores that are on."""
    return _count(read_text(root, "sys/devices/system/cpu/online"))


def usable_cores(root: Path = ROOT) -> int | None:
    """Logical cores that this process may run on (its affinity, not the container's quota)."""
    match = re.search(r"^Cpus_allowed_list:\s*(\S+)$", read_text(root, "proc/self/status") or "", re.MULTILINE)
    return _count(match[1]) if match else online_cores(root)


def _count(ranges: str | None) -> int | None:
    """Count the entries of ``0-3,6``."""
    if ranges is None or not re.fullmatch(r"\d+(-\d+)?(,\d+(-\d+)?)*", ranges):
        return None
    ends = [[int(end) for end in part.split("-")] for part in ranges.split(",")]
    return sum(end[-1] - end[0] + 1 for end in ends)


def cpu_quota(root: Path = ROOT) -> float | None:
    """The smallest limit in cores that a control group of this process has; None when there is none."""
    limits = []
    for group in _groups(root, "cpu"):
        text = read_text(root, f"{group}/cpu.max")
        if text and (limit := re.fullmatch(r"(\d+) (\d+)", text)):
            limits.append(int(limit[1]) / int(limit[2]))
        quota = read_number(root, f"{group}/cpu.cfs_quota_us")
        period = read_number(root, f"{group}/cpu.cfs_period_us")
        if quota is not None and quota > 0 and period:
            limits.append(quota / period)
    return round(min(limits), 3) if limits else None


def memory(root: Path = ROOT) -> dict[str, float | None]:
    """Memory of the machine, what is available, and the control group's limit, in MB (10^6 bytes)."""
    text = read_text(root, "proc/meminfo") or ""
    known = {key: int(kib) * 1024 for key, kib in re.findall(r"^(\w+):\s+(\d+) kB", text, re.MULTILINE)}
    limits = []
    for group in _groups(root, "memory"):
        for name in ("memory.max", "memory.limit_in_bytes"):
            limit = read_number(root, f"{group}/{name}")
            if limit is not None and limit < NO_LIMIT_BYTES:
                limits.append(limit)
    return {
        "memory_mb": _mega(known.get("MemTotal")),
        "memory_available_mb": _mega(known.get("MemAvailable")),
        "memory_limit_mb": _mega(min(limits)) if limits else None,
    }


def _mega(count: int | None) -> float | None:
    return None if count is None else round(count / 1e6, 1)


def _groups(root: Path, controller: str) -> list[str]:
    """Directories of this process's control groups, v2 and v1, from its own up to the root."""
    groups: list[str] = []
    for line in (read_text(root, "proc/self/cgroup") or "").splitlines():
        number, controllers, path = [*line.split(":", 2), "", ""][:3]
        if number == "0" and not controllers:
            bases = ["sys/fs/cgroup", "sys/fs/cgroup/unified"]
        elif controller in controllers.split(","):
            bases = [f"sys/fs/cgroup/{controller}", f"sys/fs/cgroup/{controllers}"]
        else:
            continue
        parts = [part for part in path.split("/") if part not in ("", "..")]
        for base in dict.fromkeys(bases):
            groups += ["/".join([base, *parts[:depth]]) for depth in range(len(parts), -1, -1)]
    return groups


def frequency(root: Path = ROOT) -> dict[str, Any]:
    """Governors and the frequency policy of the processor; ``turbo`` is None where nothing tells."""
    policies = [
        path.relative_to(root).as_posix() for path in sorted((root / "sys/devices/system/cpu/cpufreq").glob("policy*"))
    ]
    governors = [governor for policy in policies if (governor := read_text(root, f"{policy}/scaling_governor"))]
    clocks: dict[str, list[float] | None] = {}
    for key, name in (("min", "scaling_min_freq"), ("max", "scaling_max_freq"), ("now", "scaling_cur_freq")):
        values = [khz / 1000 for policy in policies if (khz := read_number(root, f"{policy}/{name}")) is not None]
        clocks[f"clock_{key}_mhz"] = values or None
    no_turbo = read_number(root, "sys/devices/system/cpu/intel_pstate/no_turbo")
    boost = read_number(root, "sys/devices/system/cpu/cpufreq/boost")
    turbo = (no_turbo == 0) if no_turbo is not None else (boost == 1) if boost is not None else None
    return {"governor": ", ".join(dict.fromkeys(governors)) or None, **clocks, "turbo": turbo}


def before_run(root: Path = ROOT) -> dict[str, Any]:
    """Return the fingerprint and ``processors_busy``: the machine before a measurement loads it."""
    return {**fingerprint(root), "processors_busy": busy_processors(root)}


def busy_processors(root: Path = ROOT, seconds: float = 0.3) -> float | None:
    """Return how many processors were computing meanwhile, waited for; None where nothing tells.

    Time that the host of a virtual machine took counts, time spent waiting for disks does not.
    """
    before = _processor_time(root)
    time.sleep(seconds)
    after = _processor_time(root)
    if before is None or after is None or after[1] <= before[1]:
        return None
    cores = online_cores(root) or 1
    return round(cores * (after[0] - before[0]) / (after[1] - before[1]), 2)


def _processor_time(root: Path) -> tuple[int, int] | None:
    """Return the ticks that all processors were busy, and all their ticks (``/proc/stat``, proc.rst of Linux)."""
    match = re.search(r"^cpu +([\d ]+)", read_text(root, "proc/stat") or "", re.MULTILINE)
    ticks = [int(part) for part in match[1].split()][:8] if match else []
    if len(ticks) < 8:
        return None
    return sum(ticks) - ticks[3] - ticks[4], sum(ticks)


def os_name(root: Path = ROOT) -> str | None:
    """Name of the operating system; on a Jetson with the release of its board support package."""
    text = read_text(root, "etc/os-release") or ""
    name = re.search(r"^PRETTY_NAME=\"?([^\"\n]+)", text, re.MULTILINE)
    tegra = re.search(r"R(\d+).*?REVISION: ([\d.]+)", read_text(root, "etc/nv_tegra_release") or "")
    parts = [name[1] if name else None, f"L4T {tegra[1]}.{tegra[2]}" if tegra else None]
    return ", ".join(part for part in parts if part) or None


def container(root: Path = ROOT) -> str | None:
    """The kind of container that this process runs in, as far as it shows."""
    if (root / ".dockerenv").exists():
        return "docker"
    if (root / "run/.containerenv").exists():
        return "podman"
    match = re.search(r"docker|kubepods|containerd|libpod|lxc", read_text(root, "proc/1/cgroup") or "")
    return match[0] if match else None


def virtual_machine(root: Path = ROOT) -> bool | None:
    """Whether a hypervisor shows itself; None when the processor does not tell."""
    if read_text(root, "sys/hypervisor/type"):
        return True
    flags = re.search(r"^flags\s*:\s*(.*)$", read_text(root, "proc/cpuinfo") or "", re.MULTILINE)
    return "hypervisor" in flags[1].split() if flags else None


def versions(distributions: Iterable[str] = DISTRIBUTIONS) -> dict[str, str]:
    """Versions of the packages that are installed, without importing any."""
    from importlib import metadata  # a robot does without

    installed = {}
    for name in distributions:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return installed


def cache_directory() -> Path:
    """Return where finished stages are kept: ``$VLATOOL_CACHE``, or ``vlatool`` in the user's cache directory."""
    named = os.environ.get("VLATOOL_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vlatool"
