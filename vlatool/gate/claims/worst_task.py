"""No task loses more successes than a drop allows, however well the others do."""

from __future__ import annotations

from vlatool.accuracy.moved import drops_by_task
from vlatool.accuracy.paired import few_starts
from vlatool.gate.claims._drops import judged
from vlatool.gate.config import WorstTaskClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import CONFIDENCE, ClaimResult


def examine(episodes: Episodes, claim: WorstTaskClaim) -> ClaimResult:
    """Examine each task.

    Raises:
        DataError: when no environment is named, or it fails.
    """
    return judged("worst_task", drops_by_task(*episodes.rows, CONFIDENCE), claim.max_drop, few_starts(episodes.rows[0]))
