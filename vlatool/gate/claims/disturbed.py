"""Under disturbances, the candidate loses no more successes than a drop allows."""

from __future__ import annotations

from vlatool.accuracy.disturbed import drops_by_disturbance
from vlatool.gate.claims._drops import judged
from vlatool.gate.claims._ratio import confidence_of
from vlatool.gate.config import DisturbedClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import ClaimResult


def examine(episodes: Episodes, claim: DisturbedClaim) -> ClaimResult:
    """Examine each disturbance.

    Raises:
        DataError: when no environment is named, or it fails.
        UsageError: when neither the evaluation nor the environment knows a disturbance that is named.
    """
    kinds = len(drops_by_disturbance(episodes.rows[1]))
    return judged("disturbed", drops_by_disturbance(episodes.rows[1], confidence_of(kinds)), claim.max_drop)
