from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from telemetry_boards import (
    NUC,
    VM,
    read,
    reason,
    values,
    write,
)

from vlatool.telemetry import Reading, process, totals
from vlatool.telemetry.nvml import NvmlReader
from vlatool.telemetry.process import ProcessReader
from vlatool.telemetry.rapl import RaplReader


def test_the_own_process_is_read_from_proc(tmp_path: Path) -> None:
    found = ProcessReader.open(write(tmp_path, VM))
    assert read(found) == pytest.approx(
        {
            "process.cpu": 3.0,
            "process.memory": 256.0,
            "process.involuntary_switches": 12,
            "process.machine_steal": 2.5,
        }
    )


def test_switches_of_a_thread_that_ended_stay_counted(tmp_path: Path) -> None:
    root = write(tmp_path, VM)
    found = ProcessReader.open(root)
    (root / "proc/self/task/43/status").unlink()
    write(root, {"proc/self/task/42/status": "nonvoluntary_ctxt_switches:\t9"})
    assert read(found)["process.involuntary_switches"] == 14


def test_garbage_in_proc_gives_less(tmp_path: Path) -> None:
    root = write(tmp_path, VM)
    found = ProcessReader.open(root)
    write(root, {"proc/self/stat": "42 (x) R 1", "proc/stat": "cpu 1 2 3", "proc/self/status": "VmRSS: many kB"})
    assert [*read(found)] == ["process.involuntary_switches"]


def test_psutil_is_asked_where_there_is_no_proc(monkeypatch: pytest.MonkeyPatch) -> None:
    class Process:
        broken = False

        def __init__(self, pid: int | None = None) -> None:
            assert pid is None, "this process"

        def oneshot(self) -> Any:
            if self.broken:
                raise RuntimeError("gone")
            return open("/dev/null")

        def cpu_times(self) -> Any:
            return SimpleNamespace(user=1.5, system=0.5)

        def memory_info(self) -> Any:
            return SimpleNamespace(rss=2_000_000)

        def num_ctx_switches(self) -> Any:
            return SimpleNamespace(involuntary=4)

    monkeypatch.setattr(process, "read_text", lambda root, path: None)
    monkeypatch.setattr(process, "find", lambda root, folder, pattern: [])
    monkeypatch.setitem(sys.modules, "psutil", SimpleNamespace(Process=Process))
    found = ProcessReader.open()
    assert read(found) == {"process.cpu": 2.0, "process.memory": 2.0, "process.involuntary_switches": 4}
    monkeypatch.setattr(Process, "broken", True)
    assert read(found) == {}
    assert "pip install psutil" in reason(ProcessReader.open())
    monkeypatch.setitem(sys.modules, "psutil", None)
    assert "pip install psutil" in reason(ProcessReader.open())


class NvmlError(Exception):
    pass


def card(**answers: Any) -> SimpleNamespace:
    """A library with one card; a call without an answer is not supported, or missing when its answer is None."""
    calls = {
        "nvmlDeviceGetPowerUsage": 61_250,
        "nvmlDeviceGetTotalEnergyConsumption": 5_000_250,
        "nvmlDeviceGetTemperature": 41,
        "nvmlDeviceGetClockInfo": 1980,
        "nvmlDeviceGetCurrentClocksEventReasons": 0x01,
        **answers,
    }

    def call(value: Any) -> Any:
        def answer(*arguments: Any) -> Any:
            if isinstance(value, Exception):
                raise value
            return value

        return answer

    names = dict.fromkeys(("NVML_TEMPERATURE_GPU", "NVML_CLOCK_SM", "NVML_CLOCK_MEM"), 0)
    return SimpleNamespace(
        NVMLError=NvmlError,
        nvmlInit=call(None),
        nvmlDeviceGetCount=call(1),
        nvmlDeviceGetHandleByIndex=call("card"),
        **names,
        **{name: call(value) for name, value in calls.items() if value is not None},
    )


def nvml(monkeypatch: pytest.MonkeyPatch, library: Any) -> Any:
    monkeypatch.setitem(sys.modules, "pynvml", library)
    return NvmlReader.open()


def throttling(readings: list[Reading]) -> list[str]:
    return [one.note for one in readings if one.unit == "throttle" and one.value]


def test_a_graphics_card_is_watts_joules_degrees_and_mhz(monkeypatch: pytest.MonkeyPatch) -> None:
    found = nvml(monkeypatch, card())
    readings = found.read()
    known = values(readings)
    assert known["nvml.gpu0.power"] == pytest.approx(61.25)
    assert known["nvml.gpu0.energy"] == pytest.approx(5000.25)
    assert known["nvml.gpu0.temperature"] == 41
    assert known["nvml.gpu0.sm_clock"] == 1980
    assert throttling(readings) == [], "an idle card is not throttled"
    (total,) = totals(readings)
    assert (total.names, total.unit, total.label) == (("nvml.gpu0.energy",), "J", "graphics card")


def test_throttle_reasons_have_words_under_both_names(monkeypatch: pytest.MonkeyPatch) -> None:
    library = card(nvmlDeviceGetCurrentClocksEventReasons=None, nvmlDeviceGetCurrentClocksThrottleReasons=0x44)
    found = nvml(monkeypatch, library)
    assert throttling(found.read()) == ["software power cap", "hardware thermal slowdown"]


def test_a_card_without_energy_counter_gives_power(monkeypatch: pytest.MonkeyPatch) -> None:
    found = nvml(monkeypatch, card(nvmlDeviceGetTotalEnergyConsumption=NvmlError("Not Supported")))
    (total,) = totals(found.read())
    assert (total.names, total.unit) == (("nvml.gpu0.power",), "W")


def test_a_jetson_where_nvml_supports_nothing_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    unsupported = NvmlError("Not Supported")
    names = [name for name in vars(card()) if name.startswith("nvmlDeviceGet")]
    answers = {name: unsupported for name in names if name not in ("nvmlDeviceGetCount", "nvmlDeviceGetHandleByIndex")}
    assert "INA monitors" in reason(nvml(monkeypatch, card(**answers)))


def test_no_driver_no_library_and_no_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    library = card()

    def missing() -> None:
        raise NvmlError("NVML Shared Library Not Found")

    library.nvmlInit = missing
    assert "Shared Library Not Found" in reason(nvml(monkeypatch, library))
    assert "pip install nvidia-ml-py" in reason(nvml(monkeypatch, None))
    assert "copied tree" in reason(NvmlReader.open(tmp_path))


def test_a_card_and_a_processor_are_never_added(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = RaplReader.open(write(tmp_path, NUC))
    assert isinstance(package, RaplReader)
    readings = [*nvml(monkeypatch, card()).read(), *package.read()]
    assert [total.label for total in totals(readings)] == ["package, without the board", "graphics card"]
