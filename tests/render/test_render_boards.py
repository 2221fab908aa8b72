from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
from _render_reports import board, hwselect

from vlatool.render import render
from vlatool.render._boards import HEADS, by_state, cells, chart, costs, limit_ms, reasons, way
from vlatool.report import Measurement, Report, Row

STYLES = ("terminal", "markdown", "html")


@pytest.mark.parametrize("style", STYLES)
def test_every_board_its_reason_and_its_state_are_told(style: str) -> None:
    text = " ".join(re.sub(r"<[^>]+>|\\", " ", render(hwselect(), style)).replace("&#x27;", "'").split())
    for row in hwselect().rows:
        assert row.name in text
    for words in ("Fits", "May fit: the interval crosses a limit", "Unknown: no ground for a prediction", "Ruled out",
                  "a transformer's latency there is unknown", "costs 3,499 dollars, more than 500"):  # fmt: skip
        assert words in text


@pytest.mark.parametrize("style", STYLES)
def test_nothing_is_called_measured(style: str) -> None:
    text = render(hwselect(), style).lower()
    assert "predicted" in text
    assert "measured on" not in text


def test_states_come_in_order_and_only_those_that_occur() -> None:
    headings = [heading.split(":")[0] for heading, _ in by_state(hwselect())]
    assert headings == ["Fits", "May fit", "Unknown", "Ruled out"]
    one = replace(hwselect(), rows=hwselect().rows[:1])
    assert [heading for heading, _ in by_state(one)] == ["Fits"]
    assert sum(len(rows) for _, rows in by_state(hwselect())) == len(hwselect().rows)


def test_the_cells_of_a_board() -> None:
    assert cells(board("pi", "fits", 20.0, 1234.0)) == ["pi", "15W", "int8", "20 (10–40)", "0.51/7", "1,234"]
    assert cells(board("pi", "unknown", math.nan, 80.0))[3] == "–"
    assert len(cells(Row("bare"))) == len(HEADS)
    assert cells(Row("bare"))[1:] == ["", "–", "–", "–", "–"]


def test_a_latency_of_hundreds_has_no_decimals() -> None:
    assert cells(board("pi", "fits", 1234.5, 80.0))[3] == "1234 (617–2469)"


def test_columns_of_the_cost_that_say_nothing_are_left_out() -> None:
    titles, body = costs(hwselect())
    assert titles == ["board", "W", "mean W", "J", "owned $"]
    assert body[0] == ["raspberry-pi-5", "9.8", "5.5", "0.20", "12,345"]
    assert [line[0] for line in body] == ["raspberry-pi-5", "jetson-orin-nano", "jetson-nano", "raspberry-pi-4"]
    life = Measurement("battery_life", 12.5, "h", "predicted")
    first, *others = hwselect().rows
    report = replace(hwselect(), rows=(replace(first, measurements=(*first.measurements, life)), *others))
    titles, body = costs(report)
    assert "battery h" in titles
    assert body[0][titles.index("battery h")] in ("12", "13", "12.5")
    assert body[1][titles.index("battery h")] == "–"


def test_without_costs_there_is_no_table_of_them() -> None:
    bare = replace(hwselect(), rows=(board("pi", "fits", 20.0, 80, cost=False),))
    assert costs(bare)[1] == []
    for style in STYLES:
        assert "Power and cost" not in render(bare, style)


def test_reasons_name_board_and_engine() -> None:
    assert reasons(hwselect().rows)[0] == "raspberry-pi-5, ort_cpu: raspberry-pi-5 is fits"
    assert reasons(hwselect().rows)[-1] == "jetson-agx-thor: costs 3,499 dollars, more than 500"
    assert way(Row("bare")) == {}


@pytest.mark.parametrize(
    ("limits", "ms"), [({}, math.inf), ({"hz": 10.0}, 100.0), ({"latency_ms": 30.0}, 30.0),
                       ({"hz": 10.0, "ticks_an_inference": 4}, 400.0),
                       ({"hz": 50.0, "latency_ms": 30.0}, 20.0)],
)  # fmt: skip
def test_the_limit_is_the_stricter_of_rate_and_latency(limits: dict[str, float], ms: float) -> None:
    assert limit_ms(replace(hwselect(), limits=limits)) == ms


@pytest.mark.parametrize("width", [360, 760])
def test_the_chart_has_a_point_for_each_prediction(width: int) -> None:
    drawn = chart(hwselect(), width)
    assert drawn.count("<circle") == 4, "two boards have no latency"
    assert drawn.count('class="hollow') == 1
    assert "limit 100 ms" in drawn
    assert "raspberry-pi-5: 20 (10–40) ms" in drawn


def test_one_point_is_no_chart() -> None:
    single = replace(hwselect(), rows=(board("pi", "fits", 20.0, 80),))
    assert "Price against latency" not in render(single, "html")
    assert "Price against latency" in render(hwselect(), "html")


def test_boards_without_any_latency_have_reasons_and_no_chart() -> None:
    rows = tuple(board(name, "unknown", math.nan, 80) for name in ("a", "b", "c"))
    text = render(replace(hwselect(), rows=rows, verdict="inconclusive"), "html")
    assert "a is unknown" in text
    assert "<circle" not in text


def test_a_report_that_was_read_again_is_told_in_the_same_words() -> None:
    again = Report.from_json(hwselect().to_json())
    for style in STYLES:
        assert render(again, style) == render(hwselect(), style)
