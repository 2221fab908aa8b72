"""Drops of success, one for each task or disturbance, held against one limit."""

from __future__ import annotations

from collections.abc import Mapping

from vlatool.gate.result import ClaimResult
from vlatool.report import Measurement

SHOWN = 3


def judged(claim: str, drops: Mapping[str, Measurement], allowed: float, few: str = "") -> ClaimResult:
    """Hold drops against a limit: one that is above it fails, all must be shown to be below.

    Args:
        claim: Its name.
        drops: Title -> drop with an interval that allows for their number.
        allowed: The largest drop, a share.
        few: Why the episodes decide nothing, whatever the drops; empty where they may.
    """
    if not drops:
        return ClaimResult(claim, "inconclusive", "no episodes were played")
    above = {title: drop for title, drop in drops.items() if (drop.low or 0.0) > allowed}
    undecided = {title: drop for title, drop in drops.items() if (drop.high or 0.0) > allowed}
    verdict, shown = ("fail", above) if above else ("inconclusive", undecided) if undecided else ("pass", drops)
    order = sorted(shown, key=lambda title: -shown[title].value)
    told = "; ".join(_told(title, shown[title]) for title in order[:SHOWN])
    more = f"; and {len(order) - SHOWN} more" if len(order) > SHOWN else ""
    if few:
        verdict, more = "inconclusive", f"{more}; {few}"
    worst = max(drops.values(), key=lambda drop: drop.value)
    return ClaimResult(claim, verdict, f"more failed episodes: {told}{more}; allowed: {allowed:+.2%}", (worst,))


def _told(title: str, drop: Measurement) -> str:
    return f"{title} {drop.value:+.2%} ({drop.low or 0.0:+.2%} to {drop.high or 0.0:+.2%}, {drop.samples} episodes)"
