"""How often the variants succeed under disturbances: a dot for each, or a curve where several strengths were played."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from vlatool.measures.success import SUCCESS
from vlatool.measures.tables import UNDER
from vlatool.render._format import plain
from vlatool.render._view import is_number
from vlatool.render.charts.curves import Curve, curves
from vlatool.render.charts.shares import Share, shares
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import Chart
from vlatool.report import Report
from vlatool.stats.intervals import wilson

TITLE = "Success under disturbances"
CURVES = (
    "Dots: share of episodes that succeed at a strength, with its 95 % interval; 0 is without a disturbance, 1 what an "
    "ordinary day brings. The worst first."
)
STRONGEST = 1e6
Groups = list[tuple[str, list[Share]]]


def share_of(variant: str, css: str, value: Any, count: Any) -> Share | None:
    """Return a share with Wilson's interval; None where a report from elsewhere does not have its numbers."""
    if type(count) is not int or count < 1 or not is_number(value) or not 0 <= value <= 1:
        return None
    return Share(plain(variant), css, value, *wilson(round(value * count), count), count)


def worst_first(groups: dict[str, list[Share]]) -> Groups:
    """Return the groups, that with the worst variant first."""
    return sorted(groups.items(), key=lambda item: min(share.value for share in item[1]))


def disturbance_chart(report: Report, caption: str) -> Chart | None:
    """Return the drawing of what disturbances cost, None where none were played.

    Args:
        caption: How to read the dots of a single strength.
    """
    if found := _curves(report):
        return Chart(partial(curves, found, TITLE), f"{TITLE}. {CURVES}")
    groups = _dots(report)
    return Chart(partial(shares, groups, TITLE, "under"), f"{TITLE}. {caption}") if groups else None


def _dots(report: Report) -> Groups:
    groups: dict[str, list[Share]] = {}
    for kind, _, share in _played(report):
        groups.setdefault(kind, []).append(share)
    return worst_first(groups)


def _curves(report: Report) -> list[tuple[str, list[Curve]]]:
    """Return disturbance -> the curve of each variant; nothing where none was played at several strengths."""
    groups: dict[str, dict[tuple[str, str], dict[float, Share]]] = {}
    for kind, strength, share in _played(report):
        groups.setdefault(kind, {}).setdefault((share.variant, share.css), {})[strength] = share
    if not any(len(points) > 1 for group in groups.values() for points in group.values()):
        return []
    start = {(share.variant, share.css): share for share in _undisturbed(report)}
    found = []
    for kind, group in groups.items():
        points = {key: {**({0.0: start[key]} if key in start else {}), **own} for key, own in group.items()}
        found.append((kind, [Curve(*key, sorted(own.items(), key=lambda item: item[0]))
                             for key, own in points.items()]))  # fmt: skip
    return sorted(found, key=lambda item: min(share.value for curve in item[1] for _, share in curve.points))


def _played(report: Report) -> Iterator[tuple[str, float, Share]]:
    """Yield disturbance, strength and how often a variant succeeds then: the baseline once, then each variant."""
    base = next((row.name for row in report.rows if row.role == "baseline"), "baseline")
    known: set[tuple[str, float]] = set()
    for row, css in with_colours(report.rows):
        for record in row.details.get(UNDER, ()):
            kind = plain(record.get("disturbance", ""))
            condition = (kind, _strength(record.get("strength")))
            count = record.get("episodes")
            before = None if condition in known else share_of(base, "s-base", record.get("baseline"), count)
            own = share_of(row.name, css, record.get("success"), count)
            known.add(condition)
            yield from ((*condition, share) for share in (before, own) if share)


def _undisturbed(report: Report) -> Iterator[Share]:
    for row, css in with_colours(report.rows):
        rate = row.get(SUCCESS)
        if rate is not None and (share := share_of(row.name, css, rate.value, rate.samples)):
            yield share


def _strength(value: Any) -> float:
    """Return a strength; 1 where a report from elsewhere says something else."""
    return float(value) if is_number(value) and 0 <= value <= STRONGEST else 1.0
