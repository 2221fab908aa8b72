"""The candidate moves no more roughly, and no farther, than the baseline where both succeed."""

from __future__ import annotations

from vlatool.accuracy.moved import RATIO, ratios
from vlatool.gate.claims._ratio import confidence_of, judged
from vlatool.gate.config import MotionClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import ClaimResult
from vlatool.motion.measure import metrics

OF_BODY = ("path_length", "joint_path", "jerk", "joint_jerk")
OF_ACTIONS = ("action_rate",)
"""Metrics that count where the environment tells nothing of the robot's body."""
ZERO = " (not told, or 0 in every episode of the baseline)"
NOTHING = "no episode in which both succeed tells how they move"


def examine(episodes: Episodes, claim: MotionClaim) -> ClaimResult:
    """Examine the metrics that the claim names, or those of the body that the environment tells.

    Raises:
        DataError: when no environment is named, or it fails.
    """
    names = claim.metrics or next((own for own in (OF_BODY, OF_ACTIONS) if ratios(*episodes.rows, own)), OF_ACTIONS)
    found = ratios(*episodes.rows, names, confidence_of(len(names)))
    titles = {name: metric.title for name, metric in metrics().items()}
    told = {titles.get(name, name): ratio for name in names if (ratio := found.get(f"{name}{RATIO}"))}
    lacking = [name for name in claim.metrics if f"{name}{RATIO}" not in found]
    result = judged("motion", told, claim.margin, NOTHING)
    if lacking and result.verdict == "pass":
        return ClaimResult("motion", "inconclusive", f"no ratio of {', '.join(lacking)}{ZERO}; {result.sentence}",
                           result.measurements)  # fmt: skip
    return result
