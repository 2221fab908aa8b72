"""The candidate takes no longer for a task than the baseline, where both succeed."""

from __future__ import annotations

from vlatool.accuracy.moved import doubts, ratios
from vlatool.gate.claims._ratio import judged
from vlatool.gate.config import TaskTimeClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import CONFIDENCE, ClaimResult

METRIC = "task_time"
NOTHING = "there is no episode in which both succeed"


def examine(episodes: Episodes, claim: TaskTimeClaim) -> ClaimResult:
    """Examine the control steps of the episodes in which both succeed.

    Raises:
        DataError: when no environment is named, or it fails.
    """
    found = ratios(*episodes.rows, (METRIC,), CONFIDENCE).get(METRIC)
    nothing = doubts(*episodes.rows, (METRIC,)).get(METRIC, NOTHING)
    return judged(METRIC, {"task time": found} if found else {}, claim.margin, nothing)
