from __future__ import annotations

import errno
import math
import os
from pathlib import Path

import pytest
from _render_reports import KINDS, optimize

from vlatool import registry
from vlatool.errors import OutputError, UsageError
from vlatool.files.directory_writer import write_directory
from vlatool.render import FILES, _format, render, write_reports
from vlatool.render.charts import samples, svg
from vlatool.render.sections import details, trade_off
from vlatool.report import Measurement, Report, Row, read_report


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("html", "HtmlRenderer"),
        ("json", "JsonRenderer"),
        ("markdown", "MarkdownRenderer"),
        ("terminal", "TerminalRenderer"),
    ],
)
def test_registry_finds_each_format(name: str, expected: str) -> None:
    assert registry.load("render", name).__name__ == expected


def test_unknown_format_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'markdown'"):
        render(optimize(), "markdwn")


@pytest.mark.parametrize("kind", KINDS)
def test_json_round_trip(kind: str) -> None:
    text = render(KINDS[kind](), "json")
    assert Report.from_json(text).to_json() == text


def test_write_reports(tmp_path: Path) -> None:
    written = write_reports(optimize(), tmp_path / "new" / "reports")
    assert {path.name for path in written} == set(FILES.values())
    assert sorted(path.name for path in (tmp_path / "new" / "reports").iterdir()) == sorted(FILES.values())
    assert read_report(tmp_path / "new").title == optimize().title


def test_a_disk_that_fills_up_names_the_output_and_not_its_draft(tmp_path: Path, monkeypatch) -> None:
    def full(*_args: object, **_options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def filled(draft: Path) -> None:
        monkeypatch.setattr(Path, "write_text", full)
        write_reports(optimize(), draft)

    with pytest.raises(OutputError) as caught, write_directory(tmp_path / "out") as place:
        filled(place)
    assert caught.value.message == f"Cannot write {tmp_path / 'out'}: the disk is full."
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("value", "shown"),
    [(math.nan, "unmeasured"), (0.0, "0"), (5.0, "5"), (0.012345, "0.0123"), (9.999, "10.0"), (1234.56, "1235"),
     (-3.14159, "−3.14"), (12345.6, "12\u202f346"), (1.2345e-7, "1.23e-7"), (math.inf, "∞"), (-math.inf, "−∞")],
)  # fmt: skip
def test_numbers_have_three_significant_digits(value: float, shown: str) -> None:
    assert _format.number(value) == shown


@pytest.mark.parametrize(
    ("measurement", "shown"),
    [
        (Measurement("success", 0.984, "1", samples=1000, low=0.974, high=0.99), "98.4 % (97.4–99.0, n = 1000)"),
        (Measurement("success", 1.0, "1"), "100.0 %"),
        (Measurement("success", 0.9999, "1"), "99.99 %"),
        (Measurement("success", 0.0, "1"), "0.0 %"),
        (Measurement("agreement", 0.00042, "1"), "0.042 %"),
        (Measurement("success_drop", 0.012, "1", low=-0.003, high=0.02), "1.2 points (−0.3 to 2.0)"),
        (Measurement("success_drop", -0.02, "1"), "−2.0 points"),
        (Measurement("speedup", 3.456, "x", low=3.4, high=3.5), "3.46× (3.40–3.50)"),
        (Measurement("latency_p50", 12.0, "ms", low=11.99, high=12.01, confidence=0.9), "12.0 ms (90 %: 11.99–12.01)"),
        (Measurement("latency_p50", math.nan, "ms", note="no clock", low=1.0, high=2.0), "unmeasured: no clock"),
        (Measurement("latency_p50", math.nan, "ms"), "unmeasured"),
        (Measurement("mcnemar_p", 0.0412, "1"), "0.0412"),
        (Measurement("error.dx", 0.00123, "m", low=0.001, high=0.0015), "1.23 mm (1.00–1.50)"),
        (Measurement("travel", 0.00123, "m"), "0.00123 m"),
        (Measurement("error.gripper", 0.5, "1"), "0.500"),
        (Measurement("loss", 1e-9, "nat", low=5e-10, high=2e-9), "1.00e-9 nat (5.00e-10–2.00e-9)"),
        (Measurement("flips", 3.0, "1"), "3.00"),
        (Measurement("error.dx", 0.0, "m"), "0 mm"),
    ],
)
def test_quantities(measurement: Measurement, shown: str) -> None:
    assert _format.full(measurement) == shown


def test_labels_and_limits() -> None:
    assert _format.label("gripper_flips_baseline") == "gripper flips vs baseline"
    assert _format.label("error_expert.dx") == "error vs expert, dx"
    assert _format.limit("latency_p99_ms", 50) == ("latency p99", "50 ms")
    assert _format.limit("engine", "ort_cpu") == ("engine", "ort_cpu")
    assert _format.cell(math.nan) == "–"
    assert _format.cell(-1.23456) == "−1.235"
    assert _format.plain("a\x00\x1b[1m\n b") == "a[1m b"


def test_ecdf_keeps_ends_and_few_points() -> None:
    ordered = [float(value) for value in range(1, 5001)]
    points = samples.ecdf(ordered)
    assert len(points) <= 125
    assert points[0] == (1.0, 1 / 5000)
    assert points[-1] == (5000.0, 1.0)
    assert all(share == pytest.approx(value / 5000, abs=1e-3) for value, share in points)


def test_histogram_envelope_and_sparkline() -> None:
    assert samples.histogram([0.0, 0.5, 1.0, 2.0], lambda value: value, 2) == [1, 2]
    band = samples.Band
    assert samples.envelope([0.0, 1.0, 9.0, 10.0], [3.0, 1.0, 2.0, 9.0], 2) == [
        band(2.5, 1.0, 1.0, 2.0, 3.0, 3.0), band(7.5, 2.0, 2.0, 5.5, 9.0, 9.0),
    ]  # fmt: skip
    assert [found.at for found in samples.envelope([0.0, 0.1, 8.0], [1.0, 2.0, 3.0], 4)] == [1.0, 7.0]
    hundred = [float(value) for value in range(100)]
    assert samples.envelope([5.0] * 100, hundred, 3) == [band(5.0, 0.0, 9.0, 49.5, 89.0, 99.0)]
    assert samples.sparkline([1.0] * 5, 8) == "█"
    assert len(samples.sparkline([float(value) for value in range(100)], 8)) == 8


@pytest.mark.parametrize(("low", "high"), [(7.0, 60.0), (0.001, 5000.0), (3.0, 3.3), (1e-7, 9e-7), (0.0, 1.0)])
def test_ticks_are_few_and_inside(low: float, high: float) -> None:
    axis = svg.axis_for([low, high], 0, 100)
    ticks = axis.ticks(6)
    assert 2 <= len(ticks) <= 8
    assert all(axis.low <= value <= axis.high for value in ticks)


def test_wide_logarithmic_axis_falls_back_to_a_few_decades() -> None:
    assert len(svg.Axis(1e-6, 1e9, 0, 1, log=True).ticks(5)) >= 2
    assert len(svg.Axis(1.1, 1.9, 0, 1, log=True).ticks(5)) >= 2


def test_pareto_front_leaves_out_the_dominated() -> None:
    plot = trade_off.scatter(optimize())
    assert plot is not None
    assert [point.name for point in plot.front()] == ["pruned_50_static_int8", "static_int8", "dynamic_int8"]
    assert trade_off.scatter(Report("optimize", "t")) is None


def test_details_of_several_variants_become_one_table() -> None:
    (table,) = details.tables(optimize())
    assert [column.title for column in table.columns[:2]] == ["task", "variant"]
    assert [line.cells[0].text for line in table.lines] == ["reach", "", "", "", "", "push", "", "", "", ""]
    assert [cell.text for cell in table.lines[0].cells[2:]] == ["0.9", "0.8", "0.95", "200", "no"]


def test_details_columns_keep_their_decimals() -> None:
    records = [{"steps": 54.4, "p": 1e-12}, {"steps": 52.0, "p": 0.5}, {}, {"steps": None}]
    (table,) = details.tables(Report("evaluate", "t", rows=(Row("a", details={"d": records, "none": []}),)))
    assert table.title == "d: a"
    assert [line.cells[0].text for line in table.lines] == ["54.4", "52.0", "–"]
    assert table.lines[0].cells[1].text == "1e−12"


def test_repeated_numbers_of_another_profile_stay_with_it() -> None:
    items = tuple(
        Measurement("latency_p50", value, "ms", "predicted", where) for value, where in ((1.0, "a"), (2.0, "b"))
    )
    report = Report("optimize", "t", rows=(Row("x", measurements=items),))
    text = render(report, "markdown")
    assert text.index("1.00 ms") < text.index("Predicted for b") < text.index("2.00 ms")
    assert "nothing was measured" in text


def test_one_bound_alone_is_shown_as_one() -> None:
    full = _format.full
    assert full(Measurement("latency_p99", 10.2, "ms", samples=900, high=14.31, confidence=0.99)) == (
        "10.2 ms (99 %: ≤ 14.3, n = 900)"
    )
    assert full(Measurement("success", 0.9, "1", low=0.85)) == "90.0 % (≥ 85.0)"
    assert full(Measurement("latency_max", 10.2, "ms")) == "10.2 ms"
