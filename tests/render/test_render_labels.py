"""Names in charts: none covers another one, however close the points are, and no point is moved."""

from __future__ import annotations

import itertools
import random
import re

import pytest

from vlatool.render import render
from vlatool.render.charts.labels import Box, Label, Mark, labels
from vlatool.report import Measurement, Report, Row

FRAME = (46.0, 16.0, 992.0, 320.0)
NARROW = (46.0, 16.0, 362.0, 280.0)


def covers(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def close(count: int, spread: float, seed: int = 0, frame: Box = FRAME) -> list[Mark]:
    draw = random.Random(seed)
    middle = ((frame[0] + frame[2]) / 2, (frame[1] + frame[3]) / 2)
    return [
        Mark(middle[0] + draw.uniform(-spread, spread), middle[1] + draw.uniform(-spread, spread), f"variant_{i}", "s0")
        for i in range(count)
    ]


def is_clean(found: tuple[Label, ...], marks: list[Mark], taken: list[Box], frame: Box) -> bool:
    boxes = [label.box for label in found]
    apart = not any(covers(one, other) for one, other in itertools.combinations(boxes, 2))
    clear = not any(covers(box, other) for box in boxes for other in (*taken, *(mark.box for mark in marks)))
    lines = not any(covers(step, label.box) for each in found for step in each.way() for label in found)
    inside = all(box[0] >= frame[0] and box[2] <= frame[2] for box in boxes)
    return apart and clear and lines and inside


@pytest.mark.parametrize("count", [2, 5, 9])
@pytest.mark.parametrize("spread", [0.0, 3.0, 20.0, 100.0])
@pytest.mark.parametrize("seed", range(5))
def test_no_label_covers_a_label_a_point_or_a_line(count: int, spread: float, seed: int) -> None:
    marks, taken = close(count, spread, seed), [(46.0, 200.0, 992.0, 202.0)]
    found = labels(marks, FRAME, taken, 400)
    assert [label.mark for label in found.labels] == marks
    assert not found.legend
    assert [label.text for label in found.labels] == [mark.name for mark in marks]
    assert is_clean(found.labels, marks, taken, FRAME)


def test_points_that_are_apart_have_their_names_beside_them_without_lines() -> None:
    marks = [Mark(100, 100, "a", "s0"), Mark(500, 200, "b", "s1")]
    assert not any(label.led for label in labels(marks, FRAME, [], 400).labels)


def test_points_that_are_close_have_lines() -> None:
    assert all(label.led for label in labels(close(4, 2.0), FRAME, [], 400).labels)


@pytest.mark.parametrize("seed", range(4))
def test_where_names_do_not_fit_there_are_numbers_and_a_legend(seed: int) -> None:
    many = enumerate(close(16, 8, seed, NARROW))
    marks = [Mark(mark.x, mark.y, f"a_name_that_is_rather_long_{i}", "s0") for i, mark in many]
    found = labels(marks, NARROW, [], 300)
    assert list(found.legend) == marks
    assert [label.text for label in found.labels] == [str(number) for number in range(1, 17)]
    assert is_clean(found.labels, marks, [], NARROW)
    assert found.height > 16 * 16


def crowd(count: int) -> Report:
    rows = tuple(
        Row(f"candidate_with_a_name_{i}", "chosen" if i == 1 else "within" if i else "baseline", "",
            (Measurement("latency_p50", 10 + i / 100, "ms"), Measurement("success", 0.98, "1")))
        for i in range(count)
    )  # fmt: skip
    return Report("optimize", "t", rows=rows)


@pytest.mark.parametrize("count", [3, 8, 20])
def test_every_variant_is_named_once_in_each_drawing_and_stands_at_its_value(count: int) -> None:
    page = render(crowd(count), "html")
    for drawing in re.findall(r'<svg[^>]*aria-labelledby="scatter.*?</svg>', page, re.DOTALL):
        names = re.findall(r'<text[^>]*class="name[^>]*>(?:\d+ )?([^<]*)</text>', drawing)
        assert sorted(name for name in names if not name.isdigit()) == sorted(row.name for row in crowd(count).rows)
        assert len(re.findall(r"<title>candidate", drawing)) == count


def test_every_board_is_named_in_the_chart_of_prices() -> None:
    rows = tuple(
        Row(f"board-{i}", "within", "r",
            (Measurement("latency_p50", 20 + i / 10, "ms", "predicted", f"board-{i}", low=15.0, high=30.0),
             Measurement("price", 250.0, "USD", "predicted", f"board-{i}")),
            details={"way": [{"state": "fits", "engine": "e", "precision": "int8"}]})
        for i in range(6)
    )  # fmt: skip
    page = render(Report("hwselect", "boards", rows=rows, limits={"hz": 5}), "html")
    for drawing in re.findall(r'<svg[^>]*aria-labelledby="boards.*?</svg>', page, re.DOTALL):
        assert [drawing.count(f">board-{i}<") for i in range(6)] == [1] * 6


def test_on_a_phone_a_label_and_its_number_do_not_run_together() -> None:
    page = render(crowd(2), "html")
    (columns,) = re.findall(r"td:not\(\.gap\)\{display:grid;([^}]*)\}", page)
    assert re.search(r"column-gap:\d\dpx", columns)
    assert "110px 1fr" not in columns
