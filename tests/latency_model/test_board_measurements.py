from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vlatool.errors import DataError, ProfileError
from vlatool.graph.workload import WORKLOAD_TABLE, GraphWorkload, Workload, summarize_workload
from vlatool.hardware.profile import load_profile
from vlatool.latency_model.board_measurements import (
    BoardMeasurement,
    calibrations,
    foreign_host,
    measured_questions,
    report_measurements,
    store,
)
from vlatool.report import Measurement, Report, Row

Load = Callable[..., Workload]
PI = load_profile("raspberry-pi-5")
WORKED = {"macs": 1e9, "weights": 1e7, "activations": 5e6, "layers": 50, "traits": ["attention"], "precision": "int8"}
GOOD = BoardMeasurement(
    "raspberry-pi-5", "default", "ort_cpu", "int8", {k: v for k, v in WORKED.items() if k != "precision"}, 9.5
)


@pytest.fixture(autouse=True)
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where measurements are kept; not there yet."""
    monkeypatch.setenv("VLATOOL_CALIBRATIONS", str(tmp_path / "kept"))
    return tmp_path / "kept"


@pytest.fixture
def report(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a benchmark's report with one row."""

    def write(ms: float = 9.5, origin: str = "measured", **table: Any) -> Path:
        details = {WORKLOAD_TABLE: [WORKED | table]} if table is not None and "absent" not in table else {}
        row = Row("int8", measurements=(Measurement("latency_p50", ms, "ms", origin, samples=20),), details=details)
        (tmp_path / "report.json").write_text(Report("benchmark", "t", rows=(row,)).to_json())
        return tmp_path

    return write


def test_a_report_tells_what_was_measured(report: Callable[..., Path]) -> None:
    (found,) = report_measurements(report(engine="ort_cpu"), PI, None)
    assert found == GOOD
    question = found.question()
    assert (question.runtime, question.precision, question.compute_unit.device) == ("onnxruntime-cpu", "int8", PI.name)
    assert (question.work.macs, question.work.traits) == (1e9, {"attention"})


def test_without_an_engine_it_is_the_preferred_one(report: Callable[..., Path]) -> None:
    orin = load_profile("jetson-orin-nano")
    (found,) = report_measurements(report(), orin, "15W")
    assert (found.mode, found.engine) == ("15W", "ort_tensorrt")


def test_a_bundle_says_the_work_where_the_report_does_not(report: Callable[..., Path], load: Load) -> None:
    (found,) = report_measurements(report(absent=True), PI, None, load())
    assert found.work["macs"] == 1.8e9
    assert found.precision == "float32"


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"absent": True}, "its rows have no workload"),
        ({"engine": "ort_tensorrt"}, "it has no latency of an engine of this board"),
        ({"origin": "predicted"}, "it has no latency of an engine of this board"),
        ({"ms": math.nan}, "it has no latency of an engine of this board"),
    ],
    ids=["no-work", "other-engine", "predicted", "no-number"],
)
def test_what_cannot_calibrate_says_why(report: Callable[..., Path], settings: dict[str, Any], why: str) -> None:
    with pytest.raises(DataError, match=why) as caught:
        report_measurements(report(**settings), PI, None)
    assert "--bundle" in caught.value.fix


@pytest.mark.parametrize(
    ("run", "why"),
    [({"rate_hz": 50.0}, "it was paced"), ({"emulates": PI.name}, "it emulates raspberry-pi-5 on another")],
)
def test_a_run_that_was_paced_or_emulated_calibrates_nothing(report: Callable[..., Path], run: Any, why: str) -> None:
    file = report() / "report.json"
    file.write_text(replace(Report.from_json(file.read_text()), environment={"run": run}).to_json())
    with pytest.raises(DataError, match=why):
        report_measurements(file, PI, None)


def test_an_unknown_mode_is_refused(report: Callable[..., Path]) -> None:
    with pytest.raises(ProfileError, match="no power mode '9W'"):
        report_measurements(report(), PI, "9W")


def test_measurements_are_kept_once_each_and_read_again(kept: Path) -> None:
    other = replace(GOOD, ms=12.0, engine="ort_cpu", precision="float32")
    assert store([GOOD]) == kept / "raspberry-pi-5.json"
    store([GOOD, other])
    found = measured_questions()
    assert [ms for _, ms in found] == [9.5, 12.0]
    assert [question.precision for question, _ in found] == ["int8", "float32"]
    assert measured_questions(kept / "raspberry-pi-5.json") == found
    assert [path.name for path in kept.iterdir()] == ["raspberry-pi-5.json"], "no draft is left"


def test_boards_are_kept_apart(kept: Path) -> None:
    store([GOOD])
    store([replace(GOOD, profile="jetson-orin-nano", mode="25W", engine="ort_tensorrt")])
    assert sorted(path.name for path in kept.iterdir()) == ["jetson-orin-nano.json", "raspberry-pi-5.json"]
    assert len(measured_questions()) == 2


def test_nothing_is_kept_before_something_was_measured(kept: Path) -> None:
    assert measured_questions() == []
    assert not kept.exists()


def test_measurements_are_kept_in_the_users_data_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("VLATOOL_CALIBRATIONS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert calibrations() == tmp_path / "data/vlatool/calibrations"
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert calibrations() == tmp_path / ".local/share/vlatool/calibrations"


@pytest.mark.parametrize(
    "change",
    [
        {"ms": 0}, {"ms": -3}, {"ms": "fast"}, {"precision": "int3"}, {"precision": ["int8"]},
        {"engine": {}}, {"mode": None}, {"work": {}}, {"work": 3}, {"work": None},
        {"work": WORKED | {"traits": ["magic"]}}, {"work": WORKED | {"traits": 5}}, {"work": WORKED | {"layers": 0}},
        {"colour": "red"},
    ],
    ids=str,
)  # fmt: skip
def test_a_malformed_measurement_is_named(kept: Path, change: dict[str, Any]) -> None:
    file = store([GOOD])
    data = json.loads(file.read_text())
    data["measured"][0] |= change
    file.write_text(json.dumps(data))
    with pytest.raises(DataError, match=r"The calibration .*raspberry-pi-5.json is malformed") as caught:
        measured_questions()
    assert "profiles calibrate" in caught.value.fix


def test_a_measurement_in_a_mode_that_is_gone_names_its_file(kept: Path) -> None:
    file = store([GOOD])
    file.write_text(file.read_text().replace('"default"', '"9W"'))
    with pytest.raises(DataError, match=r"raspberry-pi-5.json does not fit any more: .*no power mode '9W'") as caught:
        measured_questions()
    assert "remove it" in caught.value.fix


@pytest.mark.parametrize(
    ("made_on", "says"),
    [({}, ""), ({"cpu": "Intel Xeon"}, "Intel Xeon"), ({"board": "Raspberry Pi 5 Model B Rev 1.0"}, ""),
     ({"board": "Raspberry Pi 4 Model B", "cpu": "4x Cortex-A72"}, "Raspberry Pi 4 Model B, 4x Cortex-A72")],
    ids=str,
)  # fmt: skip
def test_a_report_from_elsewhere_is_recognised(report: Callable[..., Path], made_on: dict[str, str], says: str) -> None:
    path = report() / "report.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"environment": made_on}))
    assert foreign_host(path, PI) == says


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"{", "malformed: JSONDecodeError"), (b"[]", "malformed: TypeError"), (b"{}", "malformed: KeyError"),
     (b"\xff\xfe", "malformed: UnicodeDecodeError"), (b"", "malformed: JSONDecodeError"),
     (b'{"measured": [3]}', "malformed: TypeError"), (b'{"measured": 3}', "malformed: TypeError")],
)  # fmt: skip
def test_what_is_no_calibration_is_refused(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "own.json").write_bytes(content)
    with pytest.raises(DataError, match=says):
        measured_questions(tmp_path / "own.json")


def test_a_missing_calibration_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read: No such file"):
        measured_questions(tmp_path / "none.json")


def test_a_table_of_work_that_lacks_a_number_is_refused(report: Callable[..., Path], tmp_path: Path) -> None:
    path = report() / "report.json"
    path.write_text(path.read_text().replace('"macs"', '"mcas"'))
    with pytest.raises(DataError):
        report_measurements(path, PI, None)


@pytest.mark.parametrize("change", [{"macs": 0.0, "layers": 0}, {"weights": 0.0}], ids=str)
def test_what_is_kept_can_be_read_again(report: Callable[..., Path], change: dict[str, Any]) -> None:
    """A measurement that the reader refuses must not be kept: every later prediction would fail on it."""
    with contextlib.suppress(DataError):
        store(report_measurements(report(**change), PI, None))
    assert isinstance(measured_questions(), list)


def test_the_work_of_an_inference_is_the_sum_over_its_graphs(load: Load) -> None:
    prefix = load(gmacs=4.0, weights_m=20.0, traits=frozenset({"attention"})).graphs["main"]
    step = GraphWorkload({"int8": 10**9}, 5, weights=1000, activations=100, traits=frozenset({"dense"}))
    found = summarize_workload(Workload({"a": prefix, "b": step, "unused": prefix}, {"a": 1, "b": 10}))
    assert found == {
        "macs": 4e9 + 10e9, "weights": 20e6 + 10_000, "activations": 2.5e6 + 1000, "layers": 21 + 50,
        "traits": ["attention", "dense"], "precision": "int8",
    }  # fmt: skip
    assert json.loads(json.dumps(found)) == found
