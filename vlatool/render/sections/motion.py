"""How the variants move, on which tasks they fail, and what disturbs them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from vlatool.render._format import plain
from vlatool.render._view import BY_TASK, SHOWN, UNDER, motion_names
from vlatool.render.cells import matrix, records_table
from vlatool.render.charts.episode import Played, episode
from vlatool.render.charts.samples import finite
from vlatool.render.charts.shares import Share, shares
from vlatool.render.charts.svg import tinted
from vlatool.render.document import Block, Chart, Section
from vlatool.report import Report, Row
from vlatool.stats.intervals import wilson

ABOUT = (
    "Ratios to the baseline in the episodes in which both succeed, less is better; steps are of all episodes, failures "
    "at full length. The task speed-up is that of an inference by the ratio of steps."
)
CAPTION = "Dots: share of episodes that succeed, with its 95 % interval; the worst first."
HELP = "Paths end at the dot; the actions of each step are below, and short marks show where a new chunk begins."
EPISODE = "episode."
AGAINST = "against the baseline, by task"
INSTRUCTIONS = "against the baseline, by instruction"


class Motion:
    """A table of ratios, success by task and under disturbances."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return one section, when episodes were played."""
        blocks: list[Block] = []
        if shown := motion_names(report):
            blocks.append(matrix(report, shown, "measured"))
        for title, groups, key in (
            ("Success by task", _by_task(report), "task"), ("Success under disturbances", _disturbed(report), "under")
        ):  # fmt: skip
            if groups:
                blocks.append(Chart(partial(shares, groups, title, key), f"{title}. {CAPTION}"))
        tables = (records_table(report, title) for title in (AGAINST, INSTRUCTIONS, UNDER))
        blocks += [table for table in tables if table]
        blocks += _episode(report)
        if blocks:
            about = ABOUT if shown else ""
            yield Section("How it moves, and where it fails", tuple(blocks), 45, "measured", about=about, brief=False)


def _episode(report: Report) -> list[Block]:
    """Return the drawing of the episode in which the variants differ most, and how it ended for each."""
    played = [Played(plain(row.name), css, series) for row, css in tinted(report.rows) if (series := _series(row))]
    table = records_table(report, SHOWN)
    if len(played) < 2 or table is None:
        return []
    title = "The episode in which the variants differ most"
    return [Chart(partial(episode, played, title), f"{title}. {HELP}"), table]


def _series(row: Row) -> dict[str, list[float]]:
    """Return the steps of the episode that a row shows; nothing where one of them is no number."""
    series = {name.removeprefix(EPISODE): list(values) for name, values in row.raw.items() if name.startswith(EPISODE)}
    usable = all(values and len(finite(values)) == len(values) for values in series.values())
    lengths = {len(values) for name, values in series.items() if name.startswith("position")}
    return series if usable and "fresh" in series and len(lengths) < 2 else {}


def _by_task(report: Report) -> list[tuple[str, list[Share]]]:
    """Return task -> how often each variant succeeds, that with the worst variant first; nothing for one task."""
    groups: dict[str, list[Share]] = {}
    for row, css in tinted(report.rows):
        for record in row.details.get(BY_TASK, ()):
            if share := _share(row.name, css, record.get("success"), record.get("episodes")):
                groups.setdefault(plain(record.get("task", "")), []).append(share)
    return _worst_first(groups) if len(groups) > 1 else []


def _disturbed(report: Report) -> list[tuple[str, list[Share]]]:
    groups: dict[str, list[Share]] = {}
    base = next((row.name for row in report.rows if row.role == "baseline"), "baseline")
    for row, css in tinted(report.rows):
        for record in row.details.get(UNDER, ()):
            kind, count = plain(record.get("disturbance", "")), record.get("episodes")
            before = None if kind in groups else _share(base, "s-base", record.get("baseline"), count)
            found = [share for share in (before, _share(row.name, css, record.get("success"), count)) if share]
            groups[kind] = [*groups.get(kind, ()), *found]
    return _worst_first({kind: group for kind, group in groups.items() if group})


def _share(variant: str, css: str, value: Any, count: Any) -> Share | None:
    """Return a share with Wilson's interval; None where a report from elsewhere does not have its numbers."""
    if type(count) is not int or count < 1 or type(value) not in (int, float) or not 0 <= value <= 1:
        return None
    return Share(plain(variant), css, value, *wilson(round(value * count), count), count)


def _worst_first(groups: dict[str, list[Share]]) -> list[tuple[str, list[Share]]]:
    return sorted(groups.items(), key=lambda item: min(share.value for share in item[1]))
