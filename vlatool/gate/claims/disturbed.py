"""Under disturbances, the candidate loses no more successes than a drop allows."""

from __future__ import annotations

from vlatool.accuracy.disturbed import drops_by_disturbance
from vlatool.accuracy.paired import few_starts
from vlatool.gate.claims._drops import judged
from vlatool.gate.config import DisturbedClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import CONFIDENCE, ClaimResult


def examine(episodes: Episodes, claim: DisturbedClaim) -> ClaimResult:
    """Examine each disturbance.

    Raises:
        DataError: when no environment is named, or it fails.
        UsageError: when neither the evaluation nor the environment knows a disturbance that is named.
    """
    return judged(
        "disturbed", drops_by_disturbance(episodes.rows[1], CONFIDENCE), claim.max_drop, few_starts(episodes.rows[0])
    )
