"""No task loses more successes than a drop allows, however well the others do."""

from __future__ import annotations

from vlatool.accuracy.moved import drops_by_task
from vlatool.gate.claims._ratio import confidence_of
from vlatool.gate.config import WorstTaskClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import ClaimResult


def examine(episodes: Episodes, claim: WorstTaskClaim) -> ClaimResult:
    """Examine each task: one whose drop is above the limit fails, all must be shown to be below.

    Raises:
        DataError: when no environment is named, or it fails.
    """
    drops = drops_by_task(*episodes.rows, confidence_of(len(drops_by_task(*episodes.rows))))
    allowed = claim.max_drop
    above = {task: drop for task, drop in drops.items() if (drop.low or 0.0) > allowed}
    open_ = {task: drop for task, drop in drops.items() if (drop.high or 0.0) > allowed}
    verdict, shown = ("fail", above) if above else ("inconclusive", open_) if open_ else ("pass", drops)
    told = [f"{task} {drop.value:+.2%} ({drop.low or 0.0:+.2%} to {drop.high or 0.0:+.2%}, {drop.samples} episodes)"
            for task, drop in sorted(shown.items(), key=lambda item: -item[1].value)]  # fmt: skip
    worst = max(drops.values(), key=lambda drop: drop.value, default=None)
    words = f"more failed episodes: {'; '.join(told[:3])}{f'; and {len(told) - 3} more' if len(told) > 3 else ''}"
    return ClaimResult("worst_task", verdict if drops else "inconclusive", f"{words}; allowed: {allowed:+.2%}",
                       (worst,) if worst else ())  # fmt: skip
