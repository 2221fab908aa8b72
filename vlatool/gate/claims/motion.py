"""The candidate moves no more roughly, and no farther, than the baseline where both succeed."""

from __future__ import annotations

from vlatool.accuracy.moved import RATIO, doubts, known_of, pairs_above_none, ratios
from vlatool.gate.claims._ratio import confidence_of, judged
from vlatool.gate.config import MotionClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import ClaimResult, worst
from vlatool.motion.measure import MIN_PAIRS, metrics
from vlatool.report import Row

OF_BODY = ("path_length", "joint_path", "jerk", "joint_jerk")
OF_ACTIONS = ("action_rate",)
"""Metrics that count where the environment tells nothing of the robot's body."""
NOTHING = "no episode in which both succeed tells how they move"


def examine(episodes: Episodes, claim: MotionClaim) -> ClaimResult:
    """Examine the metrics that the claim names, or those of the body that the environment tells.

    Where the baseline has nothing of a metric (no collision in any episode) there is no ratio: the candidate passes
    with nothing either, and fails where it has some in so many episodes that chance is no explanation.

    Raises:
        DataError: when no environment is named, or it fails.
    """
    names = claim.metrics or _told_of(episodes.rows[0])
    confidence = confidence_of(len(names))
    found = ratios(*episodes.rows, names, confidence)
    titles = {name: metric.title for name, metric in metrics().items()}
    told = {titles.get(name, name): ratio for name in names if (ratio := found.get(f"{name}{RATIO}"))}
    none = pairs_above_none(*episodes.rows, names)
    doubt = doubts(*episodes.rows, names)
    results = [
        _from_none(titles.get(name, name), *counts, confidence, doubt.get(name, "")) for name, counts in none.items()
    ]
    if told or not results:
        results.insert(0, judged("motion", told, claim.margin, NOTHING))
    if lacking := [name for name in names if f"{name}{RATIO}" not in found and name not in none]:
        words = "; ".join(f"no ratio of {name} ({doubt.get(name, 'not told')})" for name in lacking)
        results.insert(0, ClaimResult("motion", "inconclusive", words))
    verdict = worst(result.verdict for result in results)
    sentences = [result.sentence for result in results if result.verdict == verdict or verdict != "fail"]
    measurements = tuple(item for result in results for item in result.measurements)
    return ClaimResult("motion", verdict, "; ".join(sentences), measurements)


def _told_of(baseline: Row) -> tuple[str, ...]:
    """Return the metrics of the body that the baseline has, or that of the actions; no candidate chooses."""
    known = known_of(baseline)
    return tuple(name for name in OF_BODY if name in known) or OF_ACTIONS


def _from_none(title: str, some: int, count: int, confidence: float, doubt: str) -> ClaimResult:
    """Judge a metric that the baseline has nothing of; the test is the exact sign test of pairs, one-sided."""
    if not some:
        enough = count >= MIN_PAIRS and not doubt
        words = f"{title} 0 in all {count} common successes of both"
        return ClaimResult("motion", "pass" if enough else "inconclusive", f"{words}{doubt and f' ({doubt})'}")
    verdict = "fail" if 0.5**some <= (1 - confidence) / 2 else "inconclusive"
    return ClaimResult("motion", verdict, f"{title} in {some} of {count} common successes, in none of the baseline's")
