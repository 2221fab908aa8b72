"""The candidate takes no longer for a task than the baseline, where both succeed."""

from __future__ import annotations

from pydantic import Field

from vlatool.accuracy.motion_comparison import doubts, ratios
from vlatool.gate.claims._ratio import Ratios
from vlatool.gate.evidence import Evidence
from vlatool.gate.verdict import CONFIDENCE, Outcome, Reason, Verdict

METRIC = "task_time"
EXAMPLE = """\
task_time: null        # where both succeed, the task takes no longer
# task_time:
#   margin: 0.05
"""


class TaskTime(Ratios):
    """The candidate needs no more time for a task where both succeed (needs ``accuracy: episodes``)."""

    order = 70
    example = EXAMPLE

    margin: float = Field(0.05, ge=0, le=10, description="largest growth, a share (0.05 = 5 %)")

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine the control steps of the episodes in which both succeed."""
        rows = evidence.episodes
        if ratio := ratios(*rows, (METRIC,), CONFIDENCE).get(METRIC):
            return Verdict.of([self.judge("task time", ratio)])
        doubt = doubts(*rows, (METRIC,)).get(METRIC)
        reason = Reason.MISSING_VALUES if doubt else Reason.NO_EVIDENCE
        return Verdict(Outcome.INCONCLUSIVE, reason=reason, facts={"doubt": doubt})

    def sentence(self, verdict: Verdict) -> str:
        """Return the ratio, or why there is none."""
        if verdict.judgements:
            return self.ratio_words(verdict.judgements)
        return str(verdict.facts["doubt"] or "there is no episode in which both succeed")
