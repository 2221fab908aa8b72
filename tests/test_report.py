import json
import math
from pathlib import Path

import pytest

from vlatool.errors import DataError
from vlatool.report import Finding, Measurement, Report, Row, read_report

REPORT = Report(
    "optimize",
    "tiny on a board",
    "pass",
    ("It is faster.",),
    (
        Row(
            "float32", "baseline", measurements=(Measurement("latency_p50", 4.0, "ms", low=3.9, high=4.2, samples=50),)
        ),
        Row(
            "static_int8",
            "chosen",
            "the fastest within the limits",
            (
                Measurement("latency_p50", 2.0, "ms"),
                Measurement("latency_p50", 9.0, "ms", origin="predicted", where="raspberry-pi-5"),
                Measurement("energy", math.nan, "J", note="no meter"),
            ),
            {"latency_ms": [2.0, 2.1]},
            {"drift": [{"node": "head", "error": 0.1}]},
        ),
    ),
    {"max_drop": 0.01},
    "vlatool optimize",
    "2026-01-01T00:00:00Z",
    {"cpu": "x"},
    ("The clock changed.",),
    validity="suspect",
    findings=(Finding("suspect", "It throttled once.", "cool it"), Finding("note", "No battery.")),
)


def test_a_report_survives_json():
    again = Report.from_json(REPORT.to_json())
    assert again.to_json() == REPORT.to_json()
    assert again.rows[0] == REPORT.rows[0]
    assert (again.title, again.summary, again.warnings) == (REPORT.title, REPORT.summary, REPORT.warnings)
    assert (again.validity, again.findings) == (REPORT.validity, REPORT.findings)


def test_a_report_without_a_judgement_is_not_judged():
    old = {key: value for key, value in json.loads(REPORT.to_json()).items() if key not in ("validity", "findings")}
    again = Report.from_json(json.dumps(old))
    assert (again.validity, again.findings) == ("", ())


def test_numbers_that_could_not_be_had_are_null_and_come_back_as_nan():
    assert "NaN" not in REPORT.to_json()
    energy = Report.from_json(REPORT.to_json()).rows[1].get("energy")
    assert energy is not None
    assert math.isnan(energy.value)
    assert not energy.known
    assert Measurement("x", 0.0, "1").known


def test_an_infinite_sample_does_not_break_the_json():
    report = Report("benchmark", "t", rows=(Row("a", raw={"latency_ms": [1.0, math.inf]}),))
    assert json.loads(report.to_json())["rows"][0]["raw"]["latency_ms"] == [1.0, None]


def test_a_measured_value_is_never_mixed_with_a_predicted_one():
    row = REPORT.rows[1]
    assert row.value("latency_p50") == 2.0
    predicted = row.get("latency_p50", "predicted")
    assert predicted is not None
    assert predicted.value == 9.0
    assert row.get("memory") is None
    assert math.isnan(row.value("memory"))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Measurement("x", 1.0, "ms", origin="guessed"),
        lambda: Row("x", "winner"),
        lambda: Report("optimize", "t", "great"),
        lambda: Report("optimize", "t", validity="fine"),
        lambda: Finding("bad", "x"),
        lambda: Finding("note", 1),
    ],
)
def test_words_outside_the_vocabulary_are_refused(make):
    with pytest.raises(ValueError, match="allowed:"):
        make()


def test_a_newer_report_asks_for_an_upgrade():
    with pytest.raises(DataError, match="schema 2") as caught:
        Report.from_json(json.dumps({**json.loads(REPORT.to_json()), "schema": 2}))
    assert caught.value.fix == "upgrade vlatool"


def test_a_key_of_a_later_vlatool_is_passed_over():
    assert Report.from_json(json.dumps({**json.loads(REPORT.to_json()), "colour": "red"})).title == REPORT.title


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        "null",
        '{"schema": 1}',
        '{"schema": "1"}',
        '{"schema": 1, "kind": "a", "title": "t", "rows": [1]}',
        '{"schema": 1, "kind": "a", "title": "t", "validity": "fine"}',
        '{"schema": 1, "kind": "a", "title": "t", "findings": [{"effect": "bad", "reason": "x"}]}',
        '{"schema": 1, "kind": "a", "title": "t", "findings": ["x"]}',
    ],
)
def test_text_that_is_no_report(text):
    with pytest.raises(DataError, match="not a vlatool report"):
        Report.from_json(text)


@pytest.mark.parametrize("place", ["file.json", "report.json", "reports/report.json"])
def test_a_report_is_found_by_file_or_directory(tmp_path: Path, place: str):
    path = tmp_path / place
    path.parent.mkdir(exist_ok=True)
    path.write_text(REPORT.to_json())
    named = path if place == "file.json" else tmp_path
    assert read_report(named).title == REPORT.title


def test_no_report(tmp_path: Path):
    with pytest.raises(DataError, match="No report at"):
        read_report(tmp_path)


def test_a_report_that_cannot_be_read(tmp_path: Path):
    (tmp_path / "report.json").write_bytes(b"\xff\xff")
    with pytest.raises(DataError, match="cannot be read"):
        read_report(tmp_path)
