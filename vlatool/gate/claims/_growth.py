"""Numbers that hardly vary between runs, held against the baseline's and a margin."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field

from vlatool.gate.claim import Claim
from vlatool.gate.verdict import Judgement, Outcome, Verdict
from vlatool.report import Measurement

ROUNDING = 1e-9


class Growth(Claim):
    """The candidate does not take more than the baseline by more than a margin."""

    by_default = True

    margin: float = Field(0.1, ge=0, le=10, description="largest growth, a share")

    def judge(self, measured: Measurement, baseline: float) -> Verdict:
        """Hold a number that hardly varies against that of the baseline."""
        outcome = Outcome.PASS if measured.value / baseline - 1 <= self.margin + ROUNDING else Outcome.FAIL
        return Verdict.of([Judgement(outcome, "", measured, self.margin)], (replace(measured, value=baseline),))

    def sentence(self, verdict: Verdict) -> str:
        """Return both numbers, and the growth."""
        (mine,), (theirs,) = verdict.measurements, verdict.baseline
        words = f"{mine.value:.1f} {mine.unit}, the baseline {theirs.value:.1f} {theirs.unit}"
        return f"{words} ({mine.value / theirs.value - 1:+.1%}; allowed: {self.margin:+.1%})"
