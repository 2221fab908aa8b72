from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from html import unescape

import pytest
from _render_reports import board, hwselect

from vlatool.render import render
from vlatool.render.document import build
from vlatool.render.sections.boards import HEADS, board_table, cells, cost_table, limit_ms, scatter, way
from vlatool.report import Measurement, Report, Row

STYLES = ("terminal", "markdown", "html")


@pytest.mark.parametrize("style", STYLES)
def test_every_board_its_reason_and_its_state_are_told(style: str) -> None:
    text = " ".join(unescape(re.sub(r"<[^>]+>|\\", " ", render(hwselect(), style).replace("<wbr>", ""))).split())
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
    states = [section for section in build(hwselect()).sections if section.order == 20]
    assert [section.title.split(":")[0] for section in states] == ["Fits", "May fit", "Unknown", "Ruled out"]
    one = replace(hwselect(), rows=hwselect().rows[:1])
    assert [section.title for section in build(one).sections if section.order == 20] == ["Fits"]
    assert sum(len(section.blocks[0].lines) for section in states) == len(hwselect().rows)


def test_the_cells_of_a_board() -> None:
    assert cells(board("pi", "fits", 20.0, 1234.0)) == ["pi", "15W", "int8", "20 (10–40)", "0.51/7", "1,234"]
    assert cells(board("pi", "unknown", math.nan, 80.0))[3] == "–"
    assert len(cells(Row("bare"))) == len(HEADS)
    assert cells(Row("bare"))[1:] == ["", "–", "–", "–", "–"]


def test_a_latency_of_hundreds_has_no_decimals() -> None:
    assert cells(board("pi", "fits", 1234.5, 80.0))[3] == "1234 (617–2469)"


def costs(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Return the titles and the texts of the table of costs."""
    table = cost_table(rows)
    assert table is not None
    return [column.title for column in table.columns], [[cell.text for cell in line.cells] for line in table.lines]


def test_columns_of_the_cost_that_say_nothing_are_left_out() -> None:
    titles, body = costs(hwselect().rows)
    assert titles == ["board", "W", "mean W", "J", "owned $"]
    assert body[0] == ["raspberry-pi-5", "9.8", "5.5", "0.20", "12,345"]
    assert [line[0] for line in body] == ["raspberry-pi-5", "jetson-orin-nano", "jetson-nano", "raspberry-pi-4"]
    life = Measurement("battery_life", 12.5, "h", "predicted")
    first, *others = hwselect().rows
    report = replace(hwselect(), rows=(replace(first, measurements=(*first.measurements, life)), *others))
    titles, body = costs(report.rows)
    assert "battery h" in titles
    assert body[0][titles.index("battery h")] in ("12", "13", "12.5")
    assert body[1][titles.index("battery h")] == "–"


def test_without_costs_there_is_no_table_of_them() -> None:
    bare = replace(hwselect(), rows=(board("pi", "fits", 20.0, 80, cost=False),))
    assert cost_table(bare.rows) is None
    for style in STYLES:
        assert "Power and cost" not in render(bare, style)


def test_reasons_name_board_and_engine() -> None:
    first, *_, last = (line.remark for line in board_table(hwselect().rows).lines)
    assert first == "raspberry-pi-5, ort_cpu: raspberry-pi-5 is fits"
    assert last == "jetson-agx-thor: costs 3,499 dollars, more than 500"
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
    plot = scatter(hwselect())
    assert plot is not None
    drawn = plot.draw(width).svg()
    assert drawn.count('class="dot') == 3
    assert drawn.count('class="hollow') == 1, "two boards have no latency"
    assert drawn.count('class="ring') == 1
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
