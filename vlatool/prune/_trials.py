"""Measurements of the trials of a pruning to a latency, and the choice of the next trial."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from statistics import median, median_low

from vlatool.errors import RecipeError
from vlatool.module.edits import Edit
from vlatool.prune._latency_meter import LatencyMeter

MAX_REMAINING = 0.999
"""Largest share of the unpruned latency that a trial aims at, so that it removes something."""
SLOWDOWN_LIMIT = 1.1
"""Ratio to the least latency of the unpruned policy above which a run counts as slowed down by other programs."""
NUDGE, NUDGES = 0.01, 5
"""Share by which a goal is shifted, and how often in either direction, until it leads to a new choice."""


class Trials:
    """Measurements of each choice, over all of its runs; ``wholes`` are ms of the unpruned policy in earlier runs."""

    def __init__(self, meter: LatencyMeter, wholes: list[float]) -> None:
        self._meter, self._wholes = meter, wholes
        self._shares: dict[tuple[Edit, ...], list[float]] = {}
        self._result_ratios: list[float] = []
        self.results: list[float] = []

    @property
    def undisturbed_ms(self) -> float:
        """Latency of the unpruned policy without other programs, in ms."""
        return undisturbed_latency(self._wholes)

    @property
    def result_ratio(self) -> float:
        """Ratio of result to goal: the lower median of all trials, since other programs only slow them down."""
        return median_low(self._result_ratios)

    def measure(self, edits: tuple[Edit, ...]) -> float:
        """Measure a choice once more; return its latency over all of its runs, in ms.

        The run is interleaved with the unpruned policy, so that other programs slow both down: their ratio holds
        without them, too.
        """
        whole, (ms,) = self._meter.times([edits])
        self._wholes.append(whole)
        self._shares.setdefault(edits, []).append(ms / whole)
        return median(self._shares[edits]) * self.undisturbed_ms

    def record_result(self, edits: tuple[Edit, ...], wanted: float) -> float:
        """Return the latency of a choice over all of its runs, in ms, and record it as the result of a trial."""
        ms = median(self._shares[edits]) * self.undisturbed_ms
        self.results.append(ms)
        self._result_ratios.append(ms / wanted)
        return ms

    def next_choice(self, choose: Callable[[float], tuple[Edit, ...]], goal: float, whole: float) -> tuple[Edit, ...]:
        """Return a choice that was not measured yet, for a goal as near as possible to the given one.

        Widths change in steps, and kernels favour some of them: the next choice is often one that already missed.
        """
        first = choose(min(goal, MAX_REMAINING * whole))
        if first not in self._shares:
            return first
        for number in range(1, NUDGES + 1):
            for nudge in (1 + NUDGE * number, 1 - NUDGE * number):
                with contextlib.suppress(RecipeError):
                    if (edits := choose(min(nudge * goal, MAX_REMAINING * whole))) not in self._shares:
                        return edits
        return first


def undisturbed_latency(wholes: Sequence[float]) -> float:
    """Return the latency of the unpruned policy without other programs, in ms: the median of undisturbed runs.

    The minimum of several runs would be a lucky one, and a policy pruned by it would miss its target.
    """
    return median(ms for ms in wholes if ms <= SLOWDOWN_LIMIT * min(wholes))
