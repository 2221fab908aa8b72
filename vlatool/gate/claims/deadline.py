"""A percentile of the candidate's latency is below a deadline, on this machine."""

from __future__ import annotations

from vlatool.gate.config import DeadlineClaim
from vlatool.gate.result import ClaimResult
from vlatool.gate.timed import Timed
from vlatool.report import Measurement
from vlatool.stats.percentiles import Percentile, percentile, proven_above

LEAST, MOST = 10, 60
"""Processes that are measured at least, for they differ, and at most."""


def examine(timed: Timed, claim: DeadlineClaim) -> ClaimResult:
    """Examine the percentile; measures further processes until there are calls enough for a bound."""
    while len(timed.pairs) < LEAST:
        timed.process(len(timed.pairs))
    while not (bounded := _percentile(timed, claim)).known and len(timed.pairs) < MOST:
        timed.process(len(timed.pairs))
    calls = timed.calls("candidate")
    above = proven_above(calls, claim.percent, claim.ms, processes=timed.processes())
    if not bounded.known:
        words = f"{bounded.name} needs {bounded.needed} independent calls; "
        words += f"{len(calls)} are worth {bounded.effective_sample_size:.0f}"
        return ClaimResult("deadline", "fail" if above else "inconclusive", f"{words}; allowed: {_ms(claim.ms)}")
    verdict = "fail" if above else "pass" if bounded.bound <= claim.ms else "inconclusive"
    high, confidence = bounded.bound, bounded.confidence
    words = f"{bounded.name} {_ms(bounded.value)}, at most {_ms(high)} with {confidence:.0%} confidence"
    measured = Measurement(f"latency_{bounded.name}", bounded.value, "ms", samples=len(calls), low=None, high=high,
                           confidence=confidence, note="upper bound, distribution-free")  # fmt: skip
    words += f", {len(calls)} calls beside the baseline's; allowed: {_ms(claim.ms)}"
    return ClaimResult("deadline", verdict, words, (measured,))


def _percentile(timed: Timed, claim: DeadlineClaim) -> Percentile:
    return percentile(timed.calls("candidate"), claim.percent, processes=timed.processes())


def _ms(value: float) -> str:
    """Return four digits, and no exponent."""
    return f"{value:.0f} ms" if value >= 1000 else f"{value:.4g} ms"
