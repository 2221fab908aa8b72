"""Several policies timed in one run, taking turns, so that a slow phase of the machine hits all alike."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.bundle import Bundle
from vlatool.report import Measurement
from vlatool.runtime.policy import Policy
from vlatool.stage import Context
from vlatool.statistics import quantile_interval

BLOCKS = 20
"""Rounds in which every policy takes its turn; ratios are taken within a round."""


@dataclass
class Contestant:
    """One policy in the run: its bundle, how it is opened, and the milliseconds of each inference."""

    name: str
    bundle: Bundle
    policy: Policy
    observations: list[dict[str, Any]]
    blocks: list[list[float]] = field(default_factory=list)

    @property
    def samples(self) -> list[float]:
        """All milliseconds in the order in which they were taken."""
        return [value for block in self.blocks for value in block]


def run_interleaved(contestants: Sequence[Contestant], iterations: int, warmup: int, context: Context) -> None:
    """Time ``iterations`` inferences of each policy after ``warmup`` untimed ones, in rounds of seeded random order."""
    for contestant in contestants:
        for index in range(warmup):
            contestant.policy.infer(contestant.observations[index % len(contestant.observations)])
    each = -(-iterations // BLOCKS)
    order = np.random.default_rng(0)
    for block in range(BLOCKS):
        context.tell("measuring latency", block / BLOCKS)
        for index in order.permutation(len(contestants)):
            contestants[int(index)].blocks.append(_timed(contestants[int(index)], each))


def _timed(contestant: Contestant, count: int) -> list[float]:
    found = []
    done = len(contestant.blocks) * count
    for index in range(count):
        observation = contestant.observations[(done + index) % len(contestant.observations)]
        start = time.perf_counter_ns()
        contestant.policy.infer(observation)
        found.append((time.perf_counter_ns() - start) / 1e6)
    return found


def latency_measurements(samples: Sequence[float]) -> list[Measurement]:
    """Return p50, p90, p99 and max in ms; a percentile whose upper bound the samples do not reach is left out."""
    found = []
    for name, quantile in (("p50", 0.5), ("p90", 0.9), ("p99", 0.99)):
        value, low, high = quantile_interval(samples, quantile)
        if high is not None:
            found.append(Measurement(f"latency_{name}", value, "ms", samples=len(samples), low=low, high=high))
    return [*found, Measurement("latency_max", max(samples), "ms", samples=len(samples))]


def speedup(contestant: Contestant, reference: Contestant) -> Measurement:
    """Return reference median / own median, with the order-statistic interval of the ratios within rounds."""
    ratios = [
        float(np.median(base) / np.median(own)) for base, own in zip(reference.blocks, contestant.blocks, strict=True)
    ]
    value = float(np.median(reference.samples) / np.median(contestant.samples))
    _, low, high = quantile_interval(ratios, 0.5)
    low, high = (min(low, value) if low else low), (max(high, value) if high else high)
    note = f"ratio of medians to {reference.name}, interleaved"
    return Measurement("speedup", value, "x", samples=len(contestant.samples), low=low, high=high, note=note)


def unique_names(contestants: Sequence[Contestant]) -> None:
    """Tell contestants of the same stage apart by their directories."""
    names = [contestant.name for contestant in contestants]
    for contestant in contestants:
        if names.count(contestant.name) > 1:
            contestant.name = f"{contestant.name} ({contestant.bundle.path.name})"
