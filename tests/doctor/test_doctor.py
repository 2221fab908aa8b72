from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vlatool.doctor import doctor
from vlatool.doctor.doctor import EXTRAS, Check
from vlatool.errors import MissingExtra
from vlatool.machine import host
from vlatool.runtime.arithmetic import EXACT, SATURATING
from vlatool.runtime.engine import Engine
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.stage import products

JETSON = "NVIDIA Jetson Orin Nano Engineering Reference Developer Kit Super"


def tree(root: Path, files: dict[str, Any]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(text))
    return root


def named(checks: Iterable[Check], name: str) -> Check:
    found = [check for check in checks if check.name == name]
    assert len(found) == 1
    return found[0]


def arithmetic_of(monkeypatch: pytest.MonkeyPatch, found: str) -> list[Check]:
    monkeypatch.setattr(doctor, "int8_arithmetic", lambda engine: found)
    return list(doctor.arithmetic())


def test_int8_products_are_measured_for_every_engine(monkeypatch) -> None:
    assert {check.status for check in arithmetic_of(monkeypatch, EXACT)} == {"ok"}
    saturating = arithmetic_of(monkeypatch, SATURATING)
    assert {check.status for check in saturating} == {"warn"}
    assert "--layout ort" in named(saturating, "int8 openvino").fix
    assert "--layout openvino --reduce-range" in named(saturating, "int8 openvino").fix
    assert "saturating" in named(saturating, "int8 ort_cpu").finding


def test_avx2_without_vnni_names_flags_and_the_engine_that_is_exact() -> None:
    found = doctor.instruction_set(["avx2", "fma"])
    assert "ONNX Runtime is set to be exact" in found.finding
    assert {"--layout", "--reduce-range"} <= {*re.findall(r"--[a-z-]+", found.fix)}


def test_a_variable_that_confines_openvino_is_a_warning() -> None:
    (found,) = doctor.onednn_limit("AVX2")
    assert (found.status, "ONEDNN_MAX_CPU_ISA=AVX2" in found.finding) == ("warn", True)
    assert list(doctor.onednn_limit(None)) == []


def test_an_engine_that_is_not_installed_is_not_asked(monkeypatch) -> None:
    def missing(engine: str) -> str:
        raise MissingExtra(f"{engine} is not installed")

    monkeypatch.setattr(doctor, "int8_arithmetic", missing)
    assert list(doctor.arithmetic()) == []


def test_an_engine_that_measures_no_products_of_its_own_is_not_known(monkeypatch) -> None:
    class Bare(Engine):
        package = "numpy"

    monkeypatch.setattr(doctor.registry, "load", lambda kind, name: Bare)
    monkeypatch.setattr(doctor, "int8_arithmetic", lambda engine: products.run({"engine": engine}, print))
    (check,) = [check for check in doctor.arithmetic() if check.name == "int8 ort_cpu"]
    assert (check.status, "not known" in check.finding) == ("warn", True)


def test_every_check_says_something_and_names_are_unique(tmp_path: Path) -> None:
    for checks in (doctor.diagnose(), doctor.diagnose(tmp_path)):
        assert len({check.name for check in checks}) == len(checks)
        for check in checks:
            assert check.finding
            assert check.status in ("ok", "warn", "missing")
            assert not (check.status == "ok" and check.fix)


def test_extras_are_those_of_the_project_file() -> None:
    project = Path(__file__).parents[2] / "pyproject.toml"
    text = project.read_text().partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    listed = dict(re.findall(r"^(\w+) = \[(.*?)\]$", text, re.MULTILINE | re.DOTALL))
    assert {*listed} == {*EXTRAS}
    for extra, packages in EXTRAS.items():
        known = re.findall(r'"([A-Za-z0-9_-]+)', listed[extra])
        assert {*packages} <= {*known}, extra


def test_old_python_is_refused() -> None:
    assert doctor.python_version((3, 12, 1)).status == "ok"
    old = doctor.python_version((3, 8, 10))
    assert (old.status, old.finding) == ("missing", "Python 3.8.10; vlatool needs 3.10")


def nothing(_: object) -> list[str]:
    """An engine that does not say what it runs on."""
    return []


def test_engines_that_are_absent() -> None:
    checks = list(doctor.engines({}, None, nothing))
    assert named(checks, "engine onnxruntime").fix == "pip install 'vlatool[ort]'"
    assert "openvino" in named(checks, "engine openvino").fix
    assert named(doctor.engines({}, JETSON, nothing), "engine openvino").fix == ""


def test_engines_that_are_there() -> None:
    installed = {"onnxruntime-gpu": "1.23.2", "openvino": "2026.4.1"}
    providers = ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"]
    checks = list(doctor.engines(installed, JETSON, lambda _: providers))
    assert named(checks, "engine onnxruntime") == Check(
        "engine onnxruntime", "ok", "onnxruntime-gpu 1.23.2: Tensorrt, CUDA, CPU"
    )
    assert named(checks, "engine openvino").status == "ok"


def test_a_jetson_without_its_gpu_is_a_warning() -> None:
    found = named(
        doctor.engines({"onnxruntime": "1.31"}, JETSON, lambda _: ["CPUExecutionProvider"]), "engine onnxruntime"
    )
    assert found.status == "warn"
    assert "GPU stays idle" in found.finding
    assert "JetPack" in found.fix
    elsewhere = doctor.engines({"onnxruntime": "1.31"}, "NUC13", lambda _: ["CPUExecutionProvider"])
    assert named(elsewhere, "engine onnxruntime").status == "ok"


def test_a_runtime_that_cannot_be_imported() -> None:
    def broken(_: object) -> list[str]:
        raise MissingExtra("no", "pip install it")

    found = named(doctor.engines({"onnxruntime": "1.31"}, None, broken), "engine onnxruntime")
    assert (found.status, found.fix) == ("warn", "pip install it")


def test_providers_leave_out_azure(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = ["AzureExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setitem(sys.modules, "onnxruntime", SimpleNamespace(get_available_providers=lambda: listed))
    assert OrtCpuSession.execution_providers() == ["CPUExecutionProvider"]


def test_extras() -> None:
    checks = list(doctor.extras({"onnxruntime-gpu": "1.23", "onnx": "1.19", "tokenizers": "0.20"}))
    assert named(checks, "extra ort") == Check("extra ort", "ok", "onnxruntime 1.23")
    assert named(checks, "extra text").status == "ok"
    build = named(checks, "extra build")
    assert (build.status, build.fix) == ("missing", "pip install 'vlatool[build]'")
    assert "torch" in build.finding
    assert " onnx," not in build.finding


@pytest.mark.parametrize(
    ("features", "status", "word"),
    [
        (["avx2", "avx512_vnni", "amx_int8"], "ok", "AMX"),
        (["avx2", "avx512_vnni"], "ok", "AVX-512 VNNI"),
        (["avx2", "avx_vnni"], "ok", "AVX-VNNI"),
        (["asimd", "asimddp", "i8mm"], "ok", "i8mm"),
        (["asimd", "asimddp"], "ok", "dot product"),
        (["avx2"], "warn", "saturate"),
        (["asimd"], "warn", "slower"),
        (None, "warn", "cannot be read"),
    ],
)
def test_int8_support_says_what_it_means(features: list[str] | None, status: str, word: str) -> None:
    found = doctor.instruction_set(features)
    assert found.status == status
    assert word in found.finding


def test_telemetry_of_nothing(tmp_path: Path) -> None:
    checks = list(doctor.telemetry(tmp_path))
    assert named(checks, "power").status == "missing"
    assert "unmeasured" in named(checks, "power").finding
    assert named(checks, "temperature").status == "missing"


def test_telemetry_of_a_nuc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tree(
        tmp_path,
        {
            "sys/class/powercap/intel-rapl:0/energy_uj": "123456",
            "sys/class/thermal/thermal_zone0/type": "x86_pkg_temp",
            "sys/class/thermal/thermal_zone1/type": "acpitz",
        },
    )
    checks = list(doctor.telemetry(root))
    assert named(checks, "power RAPL").status == "ok"
    assert named(checks, "temperature").finding == "2 thermal zones: x86_pkg_temp, acpitz"

    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    locked = named(doctor.telemetry(root), "power RAPL")
    assert locked.status == "warn"
    assert 'SUBSYSTEM=="powercap"' in locked.fix


def test_telemetry_of_a_jetson(tmp_path: Path) -> None:
    root = tree(
        tmp_path,
        {
            "sys/class/hwmon/hwmon0/name": "cpufan",
            "sys/class/hwmon/hwmon3/name": "ina3221",
            "sys/class/hwmon/hwmon3/in1_label": "VDD_IN",
            "sys/class/hwmon/hwmon3/in2_label": "NC",
            "sys/class/hwmon/hwmon3/in3_label": "VDD_SOC",
        },
    )
    found = named(doctor.telemetry(root), "power INA3221")
    assert found.finding == "rails VDD_IN, VDD_SOC; VDD_IN is the whole module"
    tree(root, {"sys/class/hwmon/hwmon3/in1_label": "VDD_GPU_SOC"})
    assert "no rail is the whole module" in named(doctor.telemetry(root), "power INA3221").finding


def test_telemetry_of_a_pi(tmp_path: Path) -> None:
    root = tree(tmp_path, {"usr/bin/vcgencmd": ""})
    assert "usermod" in named(doctor.telemetry(root), "power vcgencmd").fix
    tree(root, {"dev/vcio": ""})
    assert named(doctor.telemetry(root), "power vcgencmd").status == "ok"


@pytest.mark.parametrize(
    ("model", "command"), [(JETSON, "jetson_clocks"), ("Raspberry Pi 5", "scaling_governor"), ("", "cpupower")]
)
def test_clocks_that_follow_the_load(tmp_path: Path, model: str, command: str) -> None:
    governor = "sys/devices/system/cpu/cpufreq/policy0/scaling_governor"
    root = tree(tmp_path, {governor: "schedutil", "proc/device-tree/model": model})
    found = doctor.clocks(root)
    assert found.status == "warn"
    assert command in found.fix
    assert doctor.clocks(tree(root, {governor: "performance"})).status == "ok"


def test_clocks_that_cannot_be_seen(tmp_path: Path) -> None:
    assert "cannot be checked" in doctor.clocks(tmp_path).finding


def test_cores(tmp_path: Path) -> None:
    assert doctor.cores(tmp_path).status == "warn"
    files = {"proc/self/status": "Cpus_allowed_list:\t0-3", "sys/devices/system/cpu/online": "0-3"}
    root = tree(tmp_path, files)
    assert doctor.cores(root) == Check("cores", "ok", "4 of 4 logical cores")
    tree(root, {"proc/self/cgroup": "0::/", "sys/fs/cgroup/cpu.max": "200000 100000"})
    assert "limited to 2" in doctor.cores(root).finding
    tree(root, {"sys/fs/cgroup/cpu.max": "max 100000", "proc/self/status": "Cpus_allowed_list:\t0"})
    assert "affinity" in doctor.cores(root).finding


def test_memory(tmp_path: Path) -> None:
    assert doctor.memory(tmp_path).status == "warn"
    root = tree(tmp_path, {"proc/meminfo": "MemTotal: 8000000 kB\nMemAvailable: 5000000 kB"})
    assert doctor.memory(root) == Check("memory", "ok", "5.1 GB available")
    tree(root, {"proc/self/cgroup": "0::/", "sys/fs/cgroup/memory.max": "1000000000"})
    found = doctor.memory(root)
    assert (found.status, found.finding) == ("warn", "5.1 GB available and a control group's limit of 1.0 GB")


def test_disk() -> None:
    assert doctor.disk(host.ROOT, lambda path: SimpleNamespace(free=80e9)) == Check("disk", "ok", "80.0 GB free")
    found = doctor.disk(Path("/elsewhere"), lambda path: SimpleNamespace(free=1e9))
    assert (found.status, found.finding) == ("warn", "1.0 GB free")


def test_a_library_that_fails_is_a_warning() -> None:
    def broken(_: object) -> list[str]:
        raise AttributeError("no such function")

    found = named(doctor.engines({"onnxruntime": "1.31"}, None, broken), "engine onnxruntime")
    assert (found.status, found.finding) == ("warn", "onnxruntime 1.31 fails: AttributeError: no such function")


def test_a_runtime_without_a_provider_is_a_warning() -> None:
    found = named(doctor.engines({"onnxruntime": "1.31"}, JETSON, lambda _: []), "engine onnxruntime")
    assert (found.status, "no provider" in found.finding) == ("warn", True)
    elsewhere = named(doctor.engines({"onnxruntime": "1.31"}, None, lambda _: []), "engine onnxruntime")
    assert (elsewhere.status, elsewhere.fix) == ("warn", "reinstall it")
    silent = named(doctor.engines({"openvino": "2026.4"}, None, lambda _: None), "engine openvino")
    assert (silent.status, silent.finding) == ("ok", "openvino 2026.4")
