"""A report for a board: what is predicted for it stands beside what was measured here, whose milliseconds say so."""

from __future__ import annotations

from dataclasses import replace

import pytest
from _render_reports import benchmark, optimize

from vlatool.render import render
from vlatool.render._columns import board, columns, sides
from vlatool.render._format import is_share, quantity
from vlatool.render._view import further, headline, latency
from vlatool.report import ON_BOARD, Measurement, Report, Row


def for_pi() -> Report:
    """A report for one board."""
    report = optimize()
    rows = tuple(
        replace(row, measurements=tuple(item for item in row.measurements if item.where != "jetson-orin-nano"))
        for row in report.rows
    )
    return replace(report, rows=rows)


def on_the_board() -> Report:
    """The same, made on that board."""
    report = for_pi()
    return replace(report, environment={**report.environment, ON_BOARD: "raspberry-pi-5"})


def test_milliseconds_of_this_host_come_last_and_say_so() -> None:
    titles = list(columns(for_pi()).values())
    assert titles[:2] == ["speed-up", "success"]
    assert titles[-2:] == ["p50, this host", "memory, this host"]
    assert "latency p50" not in titles
    assert next(iter(columns(on_the_board()).values())) == "latency p50"


@pytest.mark.parametrize("format", ["terminal", "markdown", "html"])
def test_no_table_has_this_hosts_milliseconds_without_its_name(format: str) -> None:
    text = render(for_pi(), format)
    assert text.lower().index("predicted for raspberry-pi-5") < text.lower().index("p50, this host")
    own = for_pi().rows[1].get("latency_p50")
    assert own is not None
    assert text.lower().index("predicted for raspberry-pi-5") < text.index(quantity(own))
    assert "Not measured on raspberry-pi-5" in " ".join(text.split())
    assert "p50, this host" not in render(on_the_board(), format).lower()


def test_both_sides_of_the_chosen_one_are_in_the_headline() -> None:
    found = sides(for_pi())
    assert found is not None
    assert (found.board, found.name) == ("raspberry-pi-5", "static_int8")
    measured, predicted = dict(found.measured), dict(found.predicted)
    assert predicted == {"latency p50": "35.4 ms (23.6–59.0)"}
    assert list(measured) == ["speed-up", "success", "drop", "size"]
    assert not any("ms" in text for text in measured.values())
    page = render(for_pi(), "html")
    head = page[page.index("<header>") : page.index("</header>")]
    assert head.index("98.1 %") < head.index("35.4 ms")
    assert "not measured there" in head


def test_a_benchmark_with_a_profile_has_both_sides_too() -> None:
    report = benchmark()
    assert sides(report) is None
    item = Measurement("latency_p50", 3.2, "ms", "predicted", "raspberry-pi-5", low=2.0, high=5.0, confidence=0.8)
    row = replace(report.rows[0], measurements=(*report.rows[0].measurements, item))
    found = sides(replace(report, rows=(row,)))
    assert found is not None
    assert dict(found.predicted) == {"latency p50": "3.20 ms (80 %: 2.00–5.00)"}
    assert dict(found.measured) == {"latency p50": "0.0412 ms (n = 30)"}
    assert board(replace(report, rows=(row,))) == ""


def test_a_limit_for_the_board_is_not_drawn_over_the_latencies_of_this_host() -> None:
    assert latency(for_pi()).limit is None
    assert latency(on_the_board()).limit == 25


def test_a_share_of_what_an_engine_reaches_is_in_per_cent_above_the_whole_too():
    assert [is_share(Measurement("reach_share", value, "1")) for value in (0.9, 2.23)] == [True, True]
    assert not is_share(Measurement("occupancy", 2.23, "1"))


def test_what_a_limit_names_is_in_the_headline() -> None:
    rows = tuple(
        Row(name, measurements=(Measurement("latency_p50", value, "ms"), Measurement("relative_error", error, "1")))
        for name, value, error in (("float32", 9.0, 0.0), ("int8", 4.0, 0.031))
    )
    report = Report("optimize", "tiny", "pass", rows=rows)
    assert [each.name for each in headline(report)] == ["latency_p50"]
    limited = replace(report, limits={"relative_error": 0.04})
    assert [each.name for each in headline(limited)] == ["latency_p50", "relative_error"]
    assert "relative_error" not in [each.name for each in further(limited)]
