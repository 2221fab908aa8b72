"""The candidate is not slower than the baseline by more than a margin."""

from __future__ import annotations

import math

from vlatool.claims._found import CONFIDENCE, Found
from vlatool.claims._timed import Timed
from vlatool.gate import LatencyClaim
from vlatool.regression import Decision, sequential
from vlatool.report import Measurement


def examine(timed: Timed, claim: LatencyClaim) -> Found:
    """Examine the slowdown of the median, process by process until it is decided."""
    decision, ratios = sequential(timed.log_ratio, claim.margin, claim.looks)
    measured = Measurement(
        "latency_ratio", decision.ratio, "x", samples=len(ratios), low=decision.low, high=decision.high,
        confidence=CONFIDENCE,
        note="candidate over baseline, fresh processes with both, Hodges-Lehmann",
    )  # fmt: skip
    return Found("latency", decision.verdict, told(decision), (measured,))


def told(decision: Decision) -> str:
    """Return a decision in words: the ratio, what it lies between, and what the processes could have found."""
    words = f"{slower(decision.ratio)} ({change(decision.low)} to {change(decision.high)}, {decision.processes} "
    words += f"processes; allowed: {change(1 + decision.margin)}); "
    words += f"a slowdown of {decision.detectable:.1%} is found 95 times in 100"
    if decision.verdict == "inconclusive":
        words += f", about {decision.wanted} processes would decide"
    return words


def slower(ratio: float) -> str:
    """Return ``4.0% slower`` or ``4.0% faster``."""
    return f"{ratio - 1:.1%} slower" if ratio >= 1 else f"{1 - ratio:.1%} faster"


def change(ratio: float) -> str:
    """Return ``+4.0%``; ``unbounded`` where too few processes give no bound."""
    return f"{ratio - 1:+.1%}" if 0 < ratio < math.inf else "unbounded"
