from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from vlatool.compare.inputs import short_names
from vlatool.report import Finding, Measurement, Report, Row

HOST = {"cpu": "Cortex-A76", "cores": 4, "governor": "performance", "versions": {"onnxruntime": "1.23.2"}}


def made(p50: float = 10.0, name: str = "int8", threads: int = 1, **changes: object) -> Report:
    """A report of one row, as the benchmark makes it."""
    items = (Measurement("latency_p50", p50, "ms", samples=200), Measurement("peak_rss", 40 * p50, "MB"))
    row = Row(name, measurements=items, details={"engine": [{"engine": "ort_cpu", "threads": threads}]})
    return replace(Report("benchmark", "t", rows=(row,), environment=HOST, validity="valid"), **changes)


def host(**changes: object) -> dict[str, object]:
    return {**HOST, **changes}


@pytest.fixture
def compared(vlatool, tmp_path):
    """Write reports to a.json, b.json, …, compare them; return status, the report, and stderr."""

    def run(*reports: Report) -> tuple[int, Report | None, str]:
        paths = [tmp_path / f"{letter}.json" for letter, _ in zip("abcdef", reports, strict=False)]
        for path, report in zip(paths, reports, strict=True):
            path.write_text(report.to_json())
        code, out, err = vlatool("compare", *paths, "--json")
        return code, Report.from_json(out) if code == 0 else None, err

    return run


def test_reports_of_one_machine_get_a_speed_up_and_the_reservation(compared):
    code, report, _ = compared(made(10.0), made(5.0), made(20.0))
    assert code == 0
    assert [(row.name, row.role) for row in report.rows] == [("a", "baseline"), ("b", "subject"), ("c", "subject")]
    assert [row.value("speedup") for row in report.rows[1:]] == [2.0, 0.5]
    assert report.rows[0].get("speedup") is None
    assert report.rows[1].get("speedup").note == "against a; the two runs were not interleaved"
    assert (report.validity, report.findings) == ("valid", ())
    assert report.summary[0] == "Median latency: a 10 ms, b 5 ms, c 20 ms."
    assert "not interleaved" in report.summary[1]
    assert report.environment == HOST


@pytest.mark.parametrize(
    ("other", "said", "speedup"),
    [
        (made(environment=host(cpu="Xeon", cores=8)),
         "The machines differ: cpu Cortex-A76 (a), Xeon (b); cores 4 (a), 8 (b)", False),
        (made(environment=host(versions={"onnxruntime": "1.24.0"})),
         "The versions differ: onnxruntime 1.23.2 (a), 1.24.0 (b)", True),
        (made(environment=host(governor="ondemand", clock_max_mhz=[1800.0, 1800.0])),
         "The clocks were set differently: governor performance (a), ondemand (b)", True),
        (made(threads=4), "The numbers of threads differ: threads 1 (a), 4 (b)", True),
    ],
)  # fmt: skip
def test_what_differs_is_named(compared, other, said, speedup):
    code, report, _ = compared(made(), other)
    assert code == 0
    assert report.validity == "suspect"
    assert [(found.effect, found.reason) for found in report.findings] == [("suspect", said)]
    assert "compare the bundles themselves" in report.findings[0].remedy
    assert (report.rows[1].get("speedup") is not None) is speedup


def test_numbers_of_two_machines_say_where(compared):
    own = Measurement("speedup", 9.0, "x")
    other = made(5.0, environment=host(cpu="Xeon"))
    other = replace(other, rows=(replace(other.rows[0], measurements=(*other.rows[0].measurements, own)),))
    _, report, _ = compared(made(), other)
    assert [row.get("latency_p50").where for row in report.rows] == ["a: Cortex-A76", "b: Xeon"]
    assert report.rows[1].get("speedup") is None
    assert report.environment["cores"] == 4
    assert report.environment["report b"]["cpu"] == "Xeon"


def test_a_machine_that_is_not_named_is_not_the_same(compared):
    _, report, _ = compared(made(environment={}), made(5.0, environment={}))
    assert report.rows[1].get("speedup") is None
    assert "no speed-up is computed" in report.summary[1]


def test_a_speed_up_over_another_baseline_is_not_kept(compared):
    def pair(p50: float) -> Report:
        found = made(p50, "float32")
        fast = Row("int8", measurements=(Measurement("latency_p50", p50 / 4, "ms"), Measurement("speedup", 4.0, "x")))
        return replace(found, rows=(replace(found.rows[0], role="baseline"), fast))

    _, report, _ = compared(pair(10.0), pair(8.0))
    assert [row.name for row in report.rows] == ["a: float32", "a: int8", "b: float32", "b: int8"]
    assert [row.value("speedup") for row in report.rows[1:]] == [4.0, 1.25, 5.0]


def test_rows_whose_names_differ_keep_them(compared):
    _, report, _ = compared(made(name="float32"), made(name="int8"))
    assert [row.name for row in report.rows] == ["float32", "int8"]


def test_the_worst_judgement_and_every_reason_are_kept(compared):
    bad = made(validity="invalid", findings=(Finding("invalid", "It lied.", "ask again"),), warnings=("hot",))
    _, report, _ = compared(made(), bad)
    assert report.validity == "invalid"
    assert report.findings == (Finding("invalid", "b: It lied.", "ask again"),)
    assert report.warnings == ("b: hot",)
    _, report, _ = compared(made(), made(validity=""))
    assert report.validity == ""


def test_only_limits_that_all_share_are_kept(compared):
    _, report, _ = compared(made(limits={"deadline_ms": 50, "hz": 20}), made(limits={"deadline_ms": 50, "hz": 10}))
    assert report.limits == {"deadline_ms": 50}


def test_a_row_that_failed_stays_failed(compared):
    row = replace(made(math.nan).rows[0], role="failed", reason="no kernel")
    failed = made(rows=(replace(row, measurements=(*row.measurements[:1], Measurement("peak_rss", 1.0, "MB"))),))
    _, report, _ = compared(made(), failed)
    assert [(row.role, row.reason) for row in report.rows] == [("baseline", ""), ("failed", "no kernel")]
    assert report.rows[1].get("speedup") is None


@pytest.mark.parametrize(
    ("other", "code", "said"),
    [
        (made(kind="hwselect"), 2, "b.json is a report of the kind 'hwselect'"),
        (made(kind="gate"), 2, "allowed: benchmark, optimize, evaluate, compare"),
        (made(rows=()), 3, "b.json has no rows"),
        (made(kind="evaluate", rows=(Row("x", measurements=(Measurement("success", 0.9, "1"),)),)), 2,
         "have no measurement in common"),
    ],
)  # fmt: skip
def test_reports_that_cannot_be_compared(compared, other, code, said):
    found, _, err = compared(made(), other)
    assert found == code
    assert said in err.replace("\n", " ")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "This is not a vlatool report"),
        ("", "This is not a vlatool report"),
        (json.dumps({**json.loads(made().to_json()), "schema": 9}), "upgrade vlatool"),
    ],
)
def test_the_bad_report_is_named(vlatool, tmp_path, text, said):
    (tmp_path / "good.json").write_text(made().to_json())
    (tmp_path / "bad.json").write_text(text)
    code, _, err = vlatool("compare", tmp_path / "good.json", tmp_path / "bad.json")
    assert code == 3
    assert "bad.json" in err
    assert "good.json" not in err
    assert said in err


def test_a_report_is_compared_once(vlatool, tmp_path):
    (tmp_path / "report.json").write_text(made().to_json())
    code, _, err = vlatool("compare", tmp_path, tmp_path / "report.json")
    assert code == 2
    assert "are the same report" in err


def test_the_front_of_reports_is_drawn_over_memory(vlatool, tmp_path):
    for name, p50 in (("a", 10.0), ("b", 5.0)):
        (tmp_path / f"{name}.json").write_text(made(p50).to_json())
    code, out, _ = vlatool("compare", tmp_path / "a.json", tmp_path / "b.json", "-o", tmp_path / "out")
    assert code == 0
    assert "2.00×" in out
    assert "The comparison is valid." in out
    assert "Peak memory against latency p50" in (tmp_path / "out/report.html").read_text()


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["x/a.json", "x/b.json"], ["a", "b"]),
        (["x/report.json", "y/report.json"], ["x", "y"]),
        (["x/reports/report.json", "y"], ["x", "y"]),
        (["p/x/report.json", "q/x/report.json"], ["p/x", "q/x"]),
        (["p/x", "x"], ["p/x", "{here}/x"]),
    ],
)
def test_names_are_the_shortest_that_differ(paths, names, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert short_names([Path(path) for path in paths]) == [name.format(here=tmp_path.name) for name in names]


@pytest.mark.parametrize(
    ("mine", "theirs", "said", "speedup"),
    [
        ({"threads": 1}, {"threads": 2}, "threads 1 (a), 2 (b)", True),
        ({"threads": 1}, {"threads": 1, "rate_hz": 50.0}, "rate hz none (a), 50.0 (b)", False),
        ({"threads": 1, "pin": "0"}, {"threads": 1}, "pin 0 (a), none (b)", True),
        ({"threads": 1}, {"threads": 1, "memory_limit_mb": 500.0}, "memory limit mb none (a), 500.0 (b)", True),
        ({"threads": 1}, {"threads": 1}, "", True),
    ],
)
def test_runs_that_were_made_in_other_ways_are_told_apart(compared, mine, theirs, said, speedup):
    one, other = (replace(made(), environment=host(run=run)) for run in (mine, theirs))
    code, report, _ = compared(one, other)
    assert code == 0
    assert [said in each.reason for each in report.findings] == ([True] if said else [])
    assert (report.rows[1].get("speedup") is not None) == speedup


def test_other_engines_are_noted_and_compared(compared):
    other = made(5.0)
    row = replace(other.rows[0], details={"engine": [{"engine": "openvino", "threads": 1}]})
    _, report, _ = compared(made(10.0), replace(other, rows=(row,)))
    assert [(each.effect, "engine ort_cpu (a), openvino (b)" in each.reason) for each in report.findings] == [
        ("note", True)
    ]
    assert report.validity == "valid"
    assert report.rows[1].value("speedup") == 2.0
