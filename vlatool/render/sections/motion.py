"""How the variants move, on which tasks they fail, and what disturbs them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from vlatool.measures import series, tables
from vlatool.render._format import plain
from vlatool.render._view import motions
from vlatool.render.cells import matrix, records_table
from vlatool.render.charts.episode import Played, episode
from vlatool.render.charts.samples import finite
from vlatool.render.charts.shares import Share, shares
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import Block, Chart, Section
from vlatool.render.sections._disturbance_chart import disturbance_chart, share_of, worst_first
from vlatool.report import Report, Row

ABOUT = (
    "Ratios to the baseline in the episodes in which both succeed, less is better; steps are of all episodes, failures "
    "at full length. The task speed-up is that of an inference by the ratio of steps."
)
TASKS = "Success by task"
CAPTION = "Dots: share of episodes that succeed, with its 95 % interval; the worst first."
HELP = "Paths end at the dot; the actions of each step are below, and short marks show where a new chunk begins."


class Motion:
    """A table of ratios, success by task and under disturbances."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return one section, when episodes were played."""
        blocks: list[Block] = []
        if shown := motions(report):
            blocks.append(matrix(report, shown, "measured"))
        if groups := _by_task(report):
            blocks.append(Chart(partial(shares, groups, TASKS, "task"), f"{TASKS}. {CAPTION}"))
        if chart := disturbance_chart(report, CAPTION):
            blocks.append(chart)
        found = (
            records_table(report, title)
            for title in (tables.AGAINST_BY_TASK, tables.AGAINST_BY_INSTRUCTION, tables.UNDER)
        )
        blocks += [table for table in found if table]
        blocks += _episode(report)
        if blocks:
            about = ABOUT if shown else ""
            yield Section("How it moves, and where it fails", tuple(blocks), 45, "measured", about=about, brief=False)


def _episode(report: Report) -> list[Block]:
    """Return the drawing of the episode in which the variants differ most, and how it ended for each."""
    played = [Played(plain(row.name), css, steps) for row, css in with_colours(report.rows) if (steps := _series(row))]
    table = records_table(report, tables.EPISODE)
    if len(played) < 2 or table is None:
        return []
    title = "The episode in which the variants differ most"
    return [Chart(partial(episode, played, title), f"{title}. {HELP}"), table]


def _series(row: Row) -> dict[str, list[float]]:
    """Return the steps of the episode that a row shows; nothing where one of them is not a number."""
    steps = {step: list(row.raw[name]) for step, name in series.EPISODE.among(row.raw).items()}
    usable = all(values and len(finite(values)) == len(values) for values in steps.values())
    lengths = {len(values) for name, values in steps.items() if name.startswith("position")}
    return steps if usable and "fresh" in steps and len(lengths) < 2 else {}


def _by_task(report: Report) -> list[tuple[str, list[Share]]]:
    """Return task -> how often each variant succeeds, that with the worst variant first; nothing for one task."""
    groups: dict[str, list[Share]] = {}
    for row, css in with_colours(report.rows):
        for record in row.details.get(tables.BY_TASK, ()):
            if share := share_of(row.name, css, record.get("success"), record.get("episodes")):
                groups.setdefault(plain(record.get("task", "")), []).append(share)
    return worst_first(groups) if len(groups) > 1 else []
