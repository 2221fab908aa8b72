"""The section of trainings: a curve, the rounds and the time of every variant that was trained."""

from __future__ import annotations

from dataclasses import replace

import pytest
from _render_reports import optimize

from vlatool.measures import series, tables
from vlatool.measures.training import TRAINING_TIME
from vlatool.render import render
from vlatool.render.charts.losses import Curve, loss_curve
from vlatool.render.document import Chart, build
from vlatool.report import Report, Row

STAGE = "distill.policy"
ROUNDS = [
    {"before step": 1, "who acted": "teacher", "episodes": 40, "success": "95.0%", "observations": 900},
    {"before step": 51, "who acted": "student", "episodes": 20, "success": "80.0%", "observations": 400},
]


def trained(name: str, losses: list[float]) -> Row:
    took = TRAINING_TIME.quantity(STAGE).measurement(754.0, samples=len(losses))
    return Row(
        name, measurements=(took,), raw={series.LOSSES.name(STAGE): losses}, details={tables.ROUNDS.name(STAGE): ROUNDS}
    )


def taught(row: Row, **about: str) -> Row:
    return replace(row, details={**row.details, tables.TEACHER.name(STAGE): [about]})


def report(*rows: Row) -> Report:
    return Report("training", "tiny", rows=rows)


def section(given: Report):
    return next((each for each in build(given).sections if each.title == "Training"), None)


def test_a_report_without_trainings_has_no_section():
    assert section(optimize()) is None


@pytest.mark.parametrize("format", ["terminal", "markdown", "html"])
def test_every_format_tells_who_acted_and_how_long_it_took(format: str):
    text = render(report(trained("small", [1 / step for step in range(1, 101)])), format)
    for words in ("small: distill.policy", "80.0%", "student", "754"):
        assert words in text, words
    assert ("<svg" in text) == (format == "html")
    assert text.count("who acted") == 1, "the details do not repeat it"


@pytest.mark.parametrize("format", ["terminal", "markdown", "html"])
def test_every_format_tells_how_much_the_teacher_counted(format: str):
    about = {"student": "1.9 M of 7.8 M parameters (24 %)", "gradient from the teacher": "62 % in step 1"}
    rows = (taught(trained("small", [2.0, 1.0]), **about), taught(trained("other", [2.0, 1.0]), **about, control="a"))
    text = render(report(*rows), format)
    for words in (*about.values(), "gradient from the teacher"):
        assert words in text, words
    assert text.count("62 % in step 1") == 2, "the details do not repeat it"


def test_every_training_has_a_drawing_of_its_own():
    both = section(report(trained("small", [2.0, 1.0, 0.5]), trained("smaller", [3.0, 2.0])))
    drawings = [block.draw(600) for block in both.blocks if isinstance(block, Chart)]
    titles = [drawing.svg().partition("Loss of ")[2].partition("<")[0] for drawing in drawings]
    assert titles == ["small: distill.policy", "smaller: distill.policy"]
    assert len({drawing.svg().partition('aria-labelledby="')[2][:12] for drawing in drawings}) == 2


@pytest.mark.parametrize("losses", [[1.0, 1.0], [0.0, 0.0], [-1.0, -2.0, -3.0], [1e-9, 1e9], [5.0] * 4000])
@pytest.mark.parametrize("width", [320, 760])
def test_any_loss_can_be_drawn(losses: list[float], width: int):
    svg = loss_curve(Curve("one", losses, (2, 3), "s0"), "0", width).svg()
    assert "nan" not in svg.lower()
    assert "polyline" in svg


def test_a_training_of_one_step_has_no_curve():
    assert section(report(trained("small", [1.0]))) is None
