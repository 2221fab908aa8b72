"""Two bundles timed call by call in one fresh process: the unit of which a gate takes several.

``python -m vlatool.measurement.turns`` reads a ``PairJob`` and answers with ``Pairs``. Both bundles are in one process
and take turns in random order, so that a slow phase of the machine hits both; the process is fresh, because how memory
happens to lie makes one process faster than the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, median

from vlatool.measurement.child import ask


@dataclass(frozen=True)
class PairJob:
    """What a process measures.

    Args:
        baseline, candidate: directories of bundles.
        engine: engine of the runtime; that which each bundle was made for when empty.
        threads: intra-op threads.
        warmup: calls of each before the first that counts.
        pairs: calls of each that count.
        seconds: time after which no further pair begins, once ``FEWEST`` are measured.
        seed: seed of the order in which the bundles are loaded and called, and of noise and changes to observations.
        observations: file of observations (``save_drawn``); drawn by the seed from the baseline alone when empty.
    """

    baseline: str
    candidate: str
    engine: str = ""
    threads: int = 1
    warmup: int = 20
    pairs: int = 150
    seconds: float = 10.0
    seed: int = 0
    observations: str = ""

    @property
    def about(self) -> str:
        """What is measured, for errors."""
        return f"{self.candidate} beside {self.baseline}"


MAX_FACTOR = 2.0
"""The largest factor that one observation counts for in the mean."""
FEWEST = 30
"""Pairs that are measured however long they take: a median of fewer says little."""


@dataclass(frozen=True)
class Pairs:
    """What a process found.

    Args:
        baseline_ms, candidate_ms: milliseconds of each call, in the order of the pairs.
        places: what each pair was called with: an observation given exactly, or the same one varied, are two places
            (``turns.variant_index``); each pair has one of its own when empty.
        slow: logarithms of candidate over baseline, of further pairs at the place that seemed the slowest for the
            candidate; empty when none seemed slow.
        slow_input: observation of that place, in words.
        looked: timed answers of the candidate that were held against those of a fresh session.
        strays: number of those that differ.
        unsteady: number of the baseline's that differ, compared when the candidate's do.
    """

    baseline_ms: tuple[float, ...]
    candidate_ms: tuple[float, ...]
    places: tuple[int, ...] = ()
    slow: tuple[float, ...] = ()
    slow_input: str = ""
    looked: int = 0
    strays: int = 0
    unsteady: int = 0

    @property
    def log_ratio(self) -> float:
        """Natural logarithm of the candidate's median over the baseline's: above 0 is slower."""
        return math.log(median(self.candidate_ms) / median(self.baseline_ms))

    @property
    def mean_log_ratio(self) -> float:
        """The mean over places of the same, each from the medians of its calls: what some slow ones change.

        One place counts for a factor of ``MAX_FACTOR`` at most: a call that the machine interrupted would outweigh all
        others, and what is slower than that at few places is found by ``slow``.
        """
        mine, theirs = (self.medians(taken) for taken in (self.candidate_ms, self.baseline_ms))
        most = math.log(MAX_FACTOR)
        return fmean(min(most, max(-most, math.log(mine[index] / theirs[index]))) for index in mine)

    def medians(self, taken: Sequence[float]) -> dict[int, float]:
        """Return place -> median of its calls, of one of the two series."""
        return medians(taken, self.places or range(len(taken)))


def medians(taken: Sequence[float], indices: Sequence[int]) -> dict[int, float]:
    """Return place -> median of its calls."""
    calls: dict[int, list[float]] = {}
    for value, index in zip(taken, indices, strict=True):
        calls.setdefault(index, []).append(value)
    return {index: median(values) for index, values in calls.items()}


def measure_pairs(job: PairJob, timeout: float | None = None) -> Pairs:
    """Measure in a fresh process; raises what a bundle raises, or GraphError when it ends or exceeds ``timeout`` s."""
    return ask("vlatool.measurement.turns", job, Pairs, job.about, timeout)
