"""No task loses more successes than a drop allows, however well the others do."""

from __future__ import annotations

from pydantic import Field

from vlatool.accuracy.motion_comparison import drops_by_task
from vlatool.accuracy.success_comparison import few_starts
from vlatool.gate.claims._drops import Drops
from vlatool.gate.evidence import Evidence
from vlatool.gate.verdict import CONFIDENCE, Verdict

EXAMPLE = """\
worst_task: null       # no task loses more than so many points, however well the others do
# worst_task:
#   max_drop: 0.03
"""


class WorstTask(Drops):
    """No task loses more successes than a drop, however well others do (needs ``accuracy: episodes``)."""

    order = 80
    example = EXAMPLE

    max_drop: float = Field(0.03, ge=0, le=1, description="largest drop of any task, a share (0.03 = 3 points)")

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine each task."""
        rows = evidence.episodes
        return self.judge(drops_by_task(*rows, CONFIDENCE), few_starts(rows[0]))
