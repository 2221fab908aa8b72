"""What was measured of each choice of a pruning to a latency, and which one to try next."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from statistics import median, median_low

from vlatool.errors import RecipeError
from vlatool.module.edits import Edit
from vlatool.prune._clock import Clock

LEAST_GONE = 0.999
"""Share of the latency of the whole policy that is left at most: something goes."""
HELD_UP = 1.1
"""Times the least latency of the whole policy from which on a run is taken to have been slowed by other programs."""
NUDGE, NUDGES = 0.01, 5
"""Share by which a goal is moved, and how often to either side, until it leads to a choice that was not tried yet."""


class Trials:
    """What was measured of each choice, all runs of it together.

    Args:
        clock: Measures.
        wholes: Milliseconds of the whole policy in the runs before.
    """

    def __init__(self, clock: Clock, wholes: list[float]) -> None:
        self._clock, self._wholes = clock, wholes
        self._shares: dict[tuple[Edit, ...], list[float]] = {}
        self._of_wanted: list[float] = []
        self.tried: list[float] = []

    @property
    def undisturbed(self) -> float:
        """What the whole policy takes where nothing else runs, in ms."""
        return undisturbed(self._wholes)

    @property
    def for_each(self) -> float:
        """Milliseconds that result where 1 is wanted: the lower median of all tries, since others only slow down."""
        return median_low(self._of_wanted)

    def measured(self, edits: tuple[Edit, ...]) -> float:
        """Measure a choice once more; return what it takes by all of its runs, in ms.

        It takes turns with the whole policy, so that other programs slow both down: their ratio says what it is without
        them.
        """
        whole, (ms,) = self._clock.times([edits])
        self._wholes.append(whole)
        self._shares.setdefault(edits, []).append(ms / whole)
        return median(self._shares[edits]) * self.undisturbed

    def seen(self, edits: tuple[Edit, ...], wanted: float) -> float:
        """Return what a choice takes by all of its runs, in ms, and remember it as the result of a try."""
        ms = median(self._shares[edits]) * self.undisturbed
        self.tried.append(ms)
        self._of_wanted.append(ms / wanted)
        return ms

    def untried(self, choose: Callable[[float], tuple[Edit, ...]], goal: float, whole: float) -> tuple[Edit, ...]:
        """Return a choice that was not measured yet, of a goal as near as possible to the one wanted.

        Widths change in steps, and kernels like some of them better: the next choice is often one that missed already.
        """
        first = choose(min(goal, LEAST_GONE * whole))
        if first not in self._shares:
            return first
        for number in range(1, NUDGES + 1):
            for nudge in (1 + NUDGE * number, 1 - NUDGE * number):
                with contextlib.suppress(RecipeError):
                    if (edits := choose(min(nudge * goal, LEAST_GONE * whole))) not in self._shares:
                        return edits
        return first


def undisturbed(wholes: Sequence[float]) -> float:
    """Return what the whole policy takes where nothing else runs, in ms: the median of the runs that were not held up.

    The least of several runs would be one on which chance smiled, and what is pruned by it would miss its target.
    """
    return median(ms for ms in wholes if ms <= HELD_UP * min(wholes))
