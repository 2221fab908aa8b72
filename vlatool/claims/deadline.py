"""A percentile of the candidate's latency is below a deadline, on this machine."""

from __future__ import annotations

from vlatool.claims._found import Found
from vlatool.claims._timed import Timed
from vlatool.gate import DeadlineClaim
from vlatool.latencies import Percentile, percentile, proven_above
from vlatool.report import Measurement

MOST = 60
"""Processes that are measured until there are calls enough."""


def examine(timed: Timed, claim: DeadlineClaim) -> Found:
    """Examine the percentile; measures further processes until there are calls enough for a bound."""
    found = _percentile(timed, claim)
    while not found.known and len(timed.pairs) < MOST:
        timed.log_ratio(len(timed.pairs))
        found = _percentile(timed, claim)
    calls = timed.calls("candidate")
    above = proven_above(calls, claim.percent, claim.ms)
    if not found.known:
        words = f"{found.name} needs {found.needed} independent calls; {len(calls)} are worth {found.worth:.0f}"
        return Found("deadline", "fail" if above else "inconclusive", f"{words}; allowed: {claim.ms:g} ms")
    verdict = "fail" if above else "pass" if found.bound <= claim.ms else "inconclusive"
    words = f"{found.name} {found.value:.3g} ms, at most {found.bound:.3g} ms with {found.confidence:.0%} confidence"
    measured = Measurement(f"latency_{found.name}", found.value, "ms", samples=len(calls), low=None, high=found.bound,
                           confidence=found.confidence, note="upper bound, distribution-free")  # fmt: skip
    return Found("deadline", verdict, f"{words}, {len(calls)} calls beside the baseline's; allowed: {claim.ms:g} ms",
                 (measured,))  # fmt: skip


def _percentile(timed: Timed, claim: DeadlineClaim) -> Percentile:
    if not timed.pairs:
        timed.log_ratio(0)
    return percentile(timed.calls("candidate"), claim.percent)
