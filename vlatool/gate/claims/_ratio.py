"""Ratios of motion held against a margin, each with its share of the chance of a false verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from vlatool.gate.result import CONFIDENCE, ClaimResult, worst
from vlatool.report import Measurement

MOST = 100_000
"""Common successes beyond which it is no advice that they would decide."""


def judged(claim: str, ratios: Mapping[str, Measurement], margin: float, nothing: str) -> ClaimResult:
    """Hold ratios to the baseline against 1 + margin: one that is above it fails, all must be shown to be below.

    Args:
        claim: Its name.
        ratios: Title -> ratio with its interval.
        margin: Largest growth, a share.
        nothing: What to say where there is no ratio.
    """
    if not ratios:
        return ClaimResult(claim, "inconclusive", nothing)
    verdicts = {title: _verdict(ratio, 1 + margin) for title, ratio in ratios.items()}
    verdict = worst(verdicts.values())
    told = [_told(title, ratio) for title, ratio in ratios.items() if verdicts[title] == verdict or verdict == "pass"]
    count = max(ratio.samples for ratio in ratios.values())
    end = f"{count} common successes; allowed: {margin:+.1%}"
    if verdict == "inconclusive" and (more := _wanted(list(ratios.values()), 1 + margin)):
        end += f"; about {more:,} would decide"
    return ClaimResult(claim, verdict, f"{', '.join(told)} ({end})", tuple(ratios.values()))


def confidence_of(count: int) -> float:
    """Return the coverage of each of several intervals, one of which alone may decide (Bonferroni)."""
    return 1 - (1 - CONFIDENCE) / max(1, count)


def _verdict(ratio: Measurement, allowed: float) -> str:
    if ratio.low is None or ratio.high is None:
        return "inconclusive"
    return "fail" if ratio.low > allowed else "pass" if ratio.high <= allowed else "inconclusive"


def _wanted(ratios: Sequence[Measurement], allowed: float) -> int:
    """Return how many common successes would decide what is undecided; 0 where no sensible number would.

    An interval narrows with the root of the number.
    """
    numbers = []
    for ratio in ratios:
        if _verdict(ratio, allowed) != "inconclusive":
            continue
        gap = abs(allowed - ratio.value)
        if ratio.low is None or ratio.high is None or not gap:
            return 0
        reach = ratio.high - ratio.value if ratio.value < allowed else ratio.value - ratio.low
        numbers.append(max(ratio.samples + 1, math.ceil(ratio.samples * (reach / gap) ** 2)))
    wanted = max(numbers, default=0)
    return wanted if wanted <= MOST else 0


def _told(title: str, ratio: Measurement) -> str:
    span = "" if ratio.low is None or ratio.high is None else f" ({ratio.low - 1:+.1%} to {ratio.high - 1:+.1%})"
    where = ratio.note.partition("; ")[2]
    return f"{title} {ratio.value - 1:+.1%}{span}{f', {where}' if where else ''}"
