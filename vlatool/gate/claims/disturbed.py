"""Under disturbances, the candidate loses no more successes than a drop allows."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field

from vlatool.accuracy.disturbance_drops import drops_by_disturbance
from vlatool.accuracy.success_comparison import few_starts
from vlatool.gate.claims._drops import Drops
from vlatool.gate.evidence import Evidence
from vlatool.gate.plan import Plan
from vlatool.gate.verdict import CONFIDENCE, Verdict

EXAMPLE = """\
disturbed: null        # nor under late, lost or noisy observations, and what else the environment offers
# disturbed:
#   max_drop: 0.05
"""


class Disturbed(Drops):
    """Under disturbances, it loses no more successes than a drop (needs ``accuracy: episodes``)."""

    order = 90
    example = EXAMPLE

    max_drop: float = Field(0.05, ge=0, le=1, description="largest drop under any of them, a share (0.05 = 5 points)")
    kinds: tuple[str, ...] = Field(
        ("all",), min_length=1, description="all, or some of delay, dropped_frames and the environment's own"
    )
    strength: float = Field(Plan.strength, gt=0, le=10, description="1 is what an ordinary day brings")

    def extend_plan(self, plan: Plan) -> Plan:
        """Let the episodes be played under these disturbances as well."""
        return replace(super().extend_plan(plan), disturb=self.kinds, strength=self.strength)

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine each disturbance; raises UsageError for one that neither evaluation nor environment knows."""
        baseline, candidate = evidence.episodes
        return self.judge(drops_by_disturbance(candidate, CONFIDENCE), few_starts(baseline))
