"""What is told while episodes are played: how many succeed so far, and by how much less than the baseline's."""

from __future__ import annotations

from collections.abc import Sequence

from vlatool.accuracy.success_comparison import Outcome
from vlatool.stats.intervals import paired_drop, wilson


class Tally:
    """Successes so far, with the intervals that a report of these episodes would have.

    Args:
        most: Episodes that there will be at most, in all.
        baseline: Outcomes of a baseline; those of the same task and seed are pairs.
    """

    def __init__(self, most: int, baseline: Sequence[Outcome] = ()) -> None:
        self._most = most
        self._baseline = {(outcome.task, outcome.seed): outcome.success for outcome in baseline}
        self._played = self._succeeded = self._pairs = self._lost = self._won = 0

    def add(self, outcomes: Sequence[Outcome]) -> None:
        """Count further episodes."""
        self._played += len(outcomes)
        self._succeeded += sum(outcome.success for outcome in outcomes)
        for outcome in outcomes:
            before = self._baseline.get((outcome.task, outcome.seed))
            if before is not None:
                self._pairs += 1
                self._lost += before and not outcome.success
                self._won += outcome.success and not before

    @property
    def share(self) -> float:
        """How much is done, 0-1."""
        return min(1.0, self._played / self._most)

    def sentence(self) -> str:
        """Return the share of successes with its Wilson interval, and the drop with its own where there are pairs.

        Example:
            >>> tally = Tally(20)
            >>> tally.add([Outcome("reach", seed, seed > 2, 5) for seed in range(10)])
            >>> tally.sentence()
            '10 of 20 episodes: 70.0 % succeed (39.7 to 89.2)'
        """
        low, high = wilson(self._succeeded, self._played)
        rate, interval = self._succeeded / self._played, f"{_percent(low)} to {_percent(high)}"
        told = f"{self._played} of {self._most} episodes: {_percent(rate)} % succeed ({interval})"
        if not self._pairs:
            return told
        drop, low, high = paired_drop(self._lost, self._won, self._pairs)
        return f"{told}, a drop of {_percent(drop)} points ({_percent(low)} to {_percent(high)})"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"
