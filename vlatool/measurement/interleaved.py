"""Several policies timed in one run, taking turns, so that a slow phase of the machine hits all alike."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.measurement.answers import Answers
from vlatool.report import Measurement
from vlatool.runtime.policy import Policy
from vlatool.stats.intervals import quantile_interval
from vlatool.stats.percentiles import PERCENTILES, Percentile, percentile

MAX_CALLS = 2_000_000
"""Largest number of calls of each policy in a run, all of which are stored."""
BLOCKS = 20
"""Rounds in which every policy takes its turn; ratios are taken within a round."""
OnProgress = Callable[[str, "float | None"], None]


@dataclass
class Contestant:
    """One policy in the run: its bundle, how it is opened, and the milliseconds of each inference.

    Args:
        starts: begin of each inference, in seconds of ``time.monotonic``.
        answers: expected answers of the policy; None when they are not compared.
    """

    name: str
    bundle: Bundle
    policy: Policy
    observations: list[dict[str, Any]]
    blocks: list[Sequence[float]] = field(default_factory=list)
    starts: array[float] = field(default_factory=lambda: array("d"))
    answers: Answers | None = None

    def warm_up(self, inferences: int) -> None:
        """Run a number of untimed inferences."""
        for index in range(inferences):
            self.policy.infer(self.observations[index % len(self.observations)])

    @property
    def samples(self) -> list[float]:
        """All milliseconds in the order in which they were taken."""
        return [value for block in self.blocks for value in block]


def run_interleaved(
    contestants: Sequence[Contestant],
    iterations: int,
    warmup: int,
    tell: OnProgress,
    duration: float = 0.0,
    between: Callable[[], None] = lambda: None,
) -> None:
    """Time each policy after ``warmup`` untimed inferences, in rounds of seeded random order.

    Args:
        contestants: get their samples.
        iterations: inferences of each, at least.
        warmup: untimed ones before.
        tell: callback: what is being done, and the share that is done.
        duration: seconds that each is timed for, at least.
        between: called before each round and after the last.
    """
    for contestant in contestants:
        contestant.warm_up(warmup)
    share = -(-iterations // BLOCKS)
    order = np.random.default_rng(0)
    for block in range(BLOCKS):
        tell("measuring latency", block / BLOCKS)
        between()
        for index in order.permutation(len(contestants)):
            _time(contestants[int(index)], share, duration / BLOCKS)
    between()


def _time(contestant: Contestant, count: int, seconds: float) -> None:
    observations, infer, answers = contestant.observations, contestant.policy.infer, contestant.answers
    taken, starts, size = array("d"), contestant.starts, len(observations)
    end = time.perf_counter() + seconds
    while len(taken) < count or (time.perf_counter() < end and len(starts) < MAX_CALLS):
        index = len(starts) % size
        if not index:
            contestant.policy.reset()  # the same noise and kept values in every turn through the observations
        observation = observations[index]
        starts.append(time.monotonic())
        start = time.perf_counter_ns()
        action = infer(observation)
        taken.append((time.perf_counter_ns() - start) / 1e6)
        if answers is not None:
            answers.look(index, action.outputs)
    contestant.blocks.append(taken)


def latency_measurements(
    samples: Sequence[float], refusals: bool = False, most: float = math.inf, seconds: float | None = None
) -> list[Measurement]:
    """Return the percentiles and the maximum in ms, each percentile with its upper bound at 99 %.

    Args:
        samples: samples in ms, in the order in which they were taken.
        refusals, most, seconds: as in ``percentile_measurements``; back to back when ``seconds`` is None.
    """
    taken = sum(samples) / 1e3 if seconds is None else seconds
    percentiles = percentile_measurements("latency", samples, PERCENTILES, refusals, most, taken)
    return [*percentiles, Measurement("latency_max", max(samples), "ms", samples=len(samples))]


def percentile_measurements(
    what: str,
    samples: Sequence[float],
    percents: Sequence[float],
    refusals: bool = False,
    most: float = math.inf,
    seconds: float = 0.0,
) -> list[Measurement]:
    """Return percentiles in ms, each with its upper bound at 99 %.

    The median is always given; without a bound where the samples are too few for one. Of an even number of calls it is
    the mean of the two in the middle, as in ``speedup_of``, so that a speed-up is the quotient of the medians beside
    it. Any other percentile that is not bounded is left out, or, with ``refusals``, named with what it would take.

    Args:
        what: name before ``_p50``.
        samples: samples in ms, in the order in which they were taken.
        percents: 0-100.
        refusals: whether a percentile that the samples cannot bound is named.
        most: independent calls that the samples are worth at most; 0 where nothing can be said.
        seconds: seconds that it took to take them, for the refusals.
    """
    measured, count = [], len(samples)
    for percent in percents:
        bounded = percentile(samples, percent, most=most)
        name = f"{what}_{bounded.name}"
        value = float(np.median(samples)) if percent == PERCENTILES[0] else bounded.value
        if bounded.known:
            high, confidence = max(bounded.bound, value), bounded.confidence
            measured.append(Measurement(name, value, "ms", samples=count, high=high, confidence=confidence))
        elif percent == PERCENTILES[0]:
            measured.append(Measurement(name, value, "ms", samples=count))
        elif refusals:
            measured.append(Measurement(name, math.nan, "ms", samples=count, note=_lacks(bounded, count, seconds)))
    return measured


def _lacks(seen: Percentile, calls: int, seconds: float) -> str:
    """Return what a percentile lacks; calls that follow each other count for less than independent ones."""
    size = seen.effective_sample_size
    if not size:
        return "ticks share inferences, so nothing bounds it; pass a lower --rate"
    more = math.ceil(1.1 * seen.needed * max(1.0, calls / size) / 100) * 100
    run = f"{calls:,} calls" if size >= calls else f"{calls:,} calls that are worth {int(size):,}"
    advice = f"pass --iterations {more} (about {seconds * more / calls:.0f} s)"
    return f"needs {seen.needed:,} independent calls, this run has {run}; {advice}"


def speedup(contestant: Contestant, reference: Contestant) -> Measurement:
    """Return reference median / own median, with the order-statistic interval of the ratios within rounds."""
    return speedup_of(contestant.blocks, reference.blocks, reference.name)


def speedup_of(
    blocks: Sequence[Sequence[float]], reference: Sequence[Sequence[float]], reference_name: str
) -> Measurement:
    """Return the speed-up from the milliseconds of both, round by round."""
    ratios = [float(np.median(base) / np.median(own)) for base, own in zip(reference, blocks, strict=True)]
    count = sum(map(len, blocks))
    value = float(np.median(np.concatenate(reference)) / np.median(np.concatenate(blocks)))
    _, low, high = quantile_interval(ratios, 0.5)
    low, high = (min(low, value) if low else low), (max(high, value) if high else high)
    note = f"ratio of medians to {reference_name}, interleaved"
    return Measurement("speedup", value, "x", samples=count, low=low, high=high, note=note)


def unique_names(contestants: Sequence[Contestant]) -> None:
    """Tell contestants of the same stage apart by their directories."""
    names = [contestant.name for contestant in contestants]
    for contestant in contestants:
        if names.count(contestant.name) > 1:
            contestant.name = f"{contestant.name} ({contestant.bundle.path.name})"
