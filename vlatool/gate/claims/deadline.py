"""A percentile of the candidate's latency is below a deadline, on this machine."""

from __future__ import annotations

from vlatool.gate.config import DeadlineClaim
from vlatool.gate.found import Found
from vlatool.gate.timed import Timed
from vlatool.report import Measurement
from vlatool.stats.percentiles import Percentile, percentile, proven_above

LEAST, MOST = 10, 60
"""Processes that are measured at least, for they differ, and at most."""


def examine(timed: Timed, claim: DeadlineClaim) -> Found:
    """Examine the percentile; measures further processes until there are calls enough for a bound."""
    while len(timed.pairs) < LEAST:
        timed.log_ratio(len(timed.pairs))
    found = _percentile(timed, claim)
    while not found.known and len(timed.pairs) < MOST:
        timed.log_ratio(len(timed.pairs))
        found = _percentile(timed, claim)
    calls = timed.calls("candidate")
    above = proven_above(calls, claim.percent, claim.ms, processes=timed.processes())
    if not found.known:
        words = f"{found.name} needs {found.needed} independent calls; {len(calls)} are worth {found.worth:.0f}"
        return Found("deadline", "fail" if above else "inconclusive", f"{words}; allowed: {_ms(claim.ms)}")
    verdict = "fail" if above else "pass" if found.bound <= claim.ms else "inconclusive"
    words = f"{found.name} {_ms(found.value)}, at most {_ms(found.bound)} with {found.confidence:.0%} confidence"
    measured = Measurement(f"latency_{found.name}", found.value, "ms", samples=len(calls), low=None, high=found.bound,
                           confidence=found.confidence, note="upper bound, distribution-free")  # fmt: skip
    return Found("deadline", verdict, f"{words}, {len(calls)} calls beside the baseline's; allowed: {_ms(claim.ms)}",
                 (measured,))  # fmt: skip


def _percentile(timed: Timed, claim: DeadlineClaim) -> Percentile:
    return percentile(timed.calls("candidate"), claim.percent, processes=timed.processes())


def _ms(value: float) -> str:
    """Return four digits, and no exponent."""
    return f"{value:.0f} ms" if value >= 1000 else f"{value:.4g} ms"
