"""A percentile of the candidate's latency is below a deadline, on this machine."""

from __future__ import annotations

from pydantic import Field, model_validator

from vlatool.files.printable import amount
from vlatool.gate.claim import Claim
from vlatool.gate.evidence import Evidence
from vlatool.gate.plan import Need
from vlatool.gate.timing_processes import Timed
from vlatool.gate.verdict import Judgement, Outcome, Verdict
from vlatool.measures.latency import LATENCY
from vlatool.stats.percentiles import PERCENTILES, Percentile, percentile, proven_above

MIN_PROCESSES, MAX_PROCESSES = 10, 60
"""Processes that are measured at least, for they differ, and at most."""
ALLOWED_PERCENTILES = ", ".join(f"{percent:g}" for percent in PERCENTILES)
EXAMPLE = """
deadline: null
# deadline:            # a percentile below a deadline, with 99 % confidence, on the machine that runs the gate
#   ms: 50
#   percent: 99
"""


class Deadline(Claim):
    """A percentile of the candidate's latency is below a deadline, with confidence; on this machine."""

    needs = frozenset({Need.TIMES})
    order = 95
    example = EXAMPLE

    ms: float = Field(gt=0, description="the deadline")
    percent: float = Field(99.0, description=f"which percentile: {ALLOWED_PERCENTILES}")

    @model_validator(mode="after")
    def _percentile_is_one(self) -> Deadline:
        if self.percent not in PERCENTILES:
            raise ValueError(f"percent must be one of {ALLOWED_PERCENTILES}")
        return self

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine the percentile; measures further processes until there are calls enough for a bound."""
        timed = evidence.timed
        while len(timed.pairs) < MIN_PROCESSES:
            timed.process(len(timed.pairs))
        while not (bounded := self._percentile(timed)).known and len(timed.pairs) < MAX_PROCESSES:
            timed.process(len(timed.pairs))
        calls = timed.calls("candidate")
        above = proven_above(calls, self.percent, self.ms, processes=timed.processes())
        below = Outcome.PASS if bounded.known and bounded.bound <= self.ms else Outcome.INCONCLUSIVE
        measured = None
        if bounded.known:
            high, confidence, note = bounded.bound, bounded.confidence, "upper bound, distribution-free"
            measured = LATENCY.quantity(bounded.name).measurement(
                bounded.value, samples=len(calls), high=high, confidence=confidence, note=note
            )
        facts = {"percentile": bounded, "calls": len(calls)}
        return Verdict.of([Judgement(Outcome.FAIL if above else below, bounded.name, measured, self.ms, facts=facts)])

    def _percentile(self, timed: Timed) -> Percentile:
        return percentile(timed.calls("candidate"), self.percent, processes=timed.processes())

    def sentence(self, verdict: Verdict) -> str:
        """Return the percentile with its bound, or how many calls it would take."""
        (judged,) = verdict.judgements
        found, calls = judged.facts["percentile"], judged.facts["calls"]
        words = f"{found.name} needs {found.needed} independent calls; {calls} are worth "
        words += f"{found.effective_sample_size:.0f}"
        if found.known:
            words = (
                f"{found.name} {_ms(found.value)}, at most {_ms(found.bound)} with {found.confidence:.0%} confidence"
            )
            words += f", {amount(calls, 'call')} beside the baseline's"
        return f"{words}; allowed: {_ms(self.ms)}"


def _ms(value: float) -> str:
    """Return four digits, and no exponent."""
    return f"{value:.0f} ms" if value >= 1000 else f"{value:.4g} ms"
