"""How variants were trained: the loss of every step, who acted in which round, and what it took."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from vlatool.measures.series import LOSSES
from vlatool.measures.tables import ROUNDS, TEACHER
from vlatool.measures.training import TRAINING_TIME
from vlatool.render._format import cell, plain, significant
from vlatool.render.cells import number, records_table, texts
from vlatool.render.charts.losses import Curve, loss_curve
from vlatool.render.charts.samples import finite
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import MISSING, Block, Chart, Column, Line, Section, Table
from vlatool.report import Report

CAPTION = (
    "Line: median of consecutive steps; bands: the middle 80 %, and smallest to largest. Vertical lines: rounds of "
)
CAPTION += "episodes that were added."
COLUMNS = (("training", False), ("steps", True), ("loss at the start", True), ("at the end", True),
           ("success in the last round", True), ("time", True))  # fmt: skip


class Training:
    """A table of all trainings, then the curve and the rounds of each."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return one section, when any variant was trained."""
        stages = sorted({stage for row in report.rows for stage in LOSSES.among(row.raw)})
        curves = {curve.name: curve for stage in stages for curve in _curves(report, stage)}
        if not curves:
            return
        blocks: list[Block] = [_table(report, stages)]
        blocks += [
            Chart(partial(loss_curve, curve, str(index)), CAPTION) for index, curve in enumerate(curves.values())
        ]
        titles = (title.name(stage) for stage in stages for title in (TEACHER, ROUNDS))
        blocks += [table for title in titles if (table := records_table(report, title))]
        yield Section("Training", tuple(blocks), 85, "measured", brief=False)


def _curves(report: Report, stage: str) -> Iterator[Curve]:
    """Yield the training by a stage of every variant that had it."""
    for row, css in with_colours(report.rows):
        losses = finite(row.raw.get(LOSSES.name(stage)) or [])
        if len(losses) > 1:
            rounds = [int(one.get("before step") or 0) for one in row.details.get(ROUNDS.name(stage), ())]
            yield Curve(_title(row.name, stage), losses, [step for step in rounds if step > 1], css)


def _title(variant: str, stage: str) -> str:
    return f"{plain(variant)}: {plain(stage)}"


def _table(report: Report, stages: list[str]) -> Table:
    lines = []
    for stage in stages:
        for row, curve in ((row, curve) for row in report.rows for curve in _curves(report, stage)
                           if curve.name == _title(row.name, stage)):  # fmt: skip
            played = [one["success"] for one in row.details.get(ROUNDS.name(stage), ()) if one.get("success")]
            first, last = map(significant, curve.ends)
            words = texts((curve.name, str(len(curve.losses)), first, last, cell(played[-1]) if played else ""))
            took = row.get(TRAINING_TIME.quantity(stage))
            lines.append(Line((*words, number(took) if took else MISSING)))
    return Table(tuple(Column(title, numeric) for title, numeric in COLUMNS), tuple(lines))
