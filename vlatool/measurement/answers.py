"""Checks of the answers of a timed policy: a fast wrong answer, or a fast cached one, does not count as an inference.

The same observation, noise and kept values must give the same answer in the timed run as in an unhurried pass before it
(MLPerf's TEST01: accuracy in performance mode). Observations that the policy has never seen must take as long as those
that the run repeats (TEST04: caching).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime.policy import Policy, relative_error
from vlatool.stats.signed_rank import lower_bound

TOLERANCE = 1e-3
"""Relative L2 difference of an output; threads that add up in another order differ by 1e-6."""
MAX_FRESH_RATIO = 1.10
"""Fresh observations that take longer than this times a repeated one mean a memory (the margin of TEST04)."""
ALPHA = 0.001
PAIRS = 40
MIN_PAIRS = 10


@dataclass(frozen=True)
class AnswerCheck:
    """Timed answers, held against those of an unhurried pass.

    Args:
        looked: number of answers that were compared.
        strays: number of those that differ.
        worst: largest relative difference; None when one is not finite, or of another shape.
        first: which of the calls was the first to differ, from 0; -1 for none.
    """

    looked: int
    strays: int
    worst: float | None
    first: int


class Answers:
    """Compares outputs with those of an unhurried pass: output name -> array of each observation."""

    def __init__(self, expected: Sequence[Mapping[str, NDArray[Any]]]) -> None:
        self._expected = [dict(outputs) for outputs in expected]
        self.looked = 0
        self.strays = 0
        self.worst = 0.0
        self.first = -1

    def __len__(self) -> int:
        """How many observations have an expected answer."""
        return len(self._expected)

    def look(self, index: int, outputs: Mapping[str, NDArray[Any]]) -> None:
        """Compare the outputs for the observation of that place."""
        for name, expected in self._expected[index].items():
            got = outputs[name]
            if not np.array_equal(got, expected):
                self._differs(got, expected)
        self.looked += 1

    def _differs(self, got: NDArray[Any], expected: NDArray[Any]) -> None:
        wrong = relative_error(got, expected) if got.shape == expected.shape else math.inf
        if not wrong <= TOLERANCE:  # also when it is not a number
            self.strays += 1
            self.worst = max(self.worst, wrong if math.isfinite(wrong) else math.inf)
            self.first = self.looked if self.first < 0 else self.first

    def check(self) -> AnswerCheck:
        """Return what was seen so far."""
        worst = self.worst if math.isfinite(self.worst) else None
        return AnswerCheck(self.looked, self.strays, worst, self.first)


def expected_answers(
    policy: Policy, observations: Sequence[Mapping[str, Any]], seconds: float = 2.0, fewest: int = 2
) -> Answers:
    """Run through the observations unhurriedly, as many as fit into some seconds, and return what they gave."""
    policy.reset()
    expected: list[Mapping[str, NDArray[Any]]] = []
    end = time.monotonic() + seconds
    for number, observation in enumerate(observations):
        if number >= fewest and time.monotonic() > end:
            break
        expected.append({name: np.array(value) for name, value in policy.infer(observation).outputs.items()})
    return Answers(expected)


@dataclass(frozen=True)
class Memory:
    """How much longer observations take that the policy has never seen.

    Args:
        ratio: ratio of the medians, fresh over repeated.
        low: lower bound of the ratio at 99.9 %; 0 when there are too few pairs.
    """

    ratio: float
    low: float
    pairs: int

    @property
    def remembers(self) -> bool:
        """Whether repeated observations are answered from memory."""
        return self.low > MAX_FRESH_RATIO


def measure_caching(
    policy: Policy, observations: Sequence[Mapping[str, Any]], seconds: float = 5.0, pairs: int = PAIRS
) -> Memory | None:
    """Time repeated observations against fresh ones in turns; None when nothing of an observation can be made fresh."""
    spec, random = policy.spec, np.random.default_rng(20)
    if not any(_can_vary(tensor) for tensor in spec.inputs):
        return None
    taken: tuple[list[float], list[float]] = ([], [])
    end = time.monotonic() + seconds
    for number in range(pairs):
        if number >= MIN_PAIRS and time.monotonic() > end:
            break
        repeated = observations[number % len(observations)]
        fresh = vary_observation(repeated, spec, random)
        for which in (0, 1) if number % 2 else (1, 0):
            observation = fresh if which else repeated
            start = time.perf_counter_ns()
            policy.infer(observation)
            taken[which].append((time.perf_counter_ns() - start) / 1e6)
    policy.reset()
    logs = [math.log(fresh / repeated) for repeated, fresh in zip(*taken, strict=True)]
    low = lower_bound(logs, ALPHA)
    ratio = float(np.median(taken[1]) / np.median(taken[0]))
    return Memory(ratio, min(ratio, math.exp(low)) if math.isfinite(low) else 0.0, len(logs))


def vary_observation(observation: Mapping[str, Any], spec: PolicySpec, random: np.random.Generator) -> dict[str, Any]:
    """Return an observation that differs a little in every input that holds pixels or measurements."""
    return {tensor.name: _vary(observation[tensor.name], tensor, random) for tensor in spec.inputs}


def _can_vary(tensor: TensorSpec) -> bool:
    return tensor.kind == "tensor" and (tensor.dtype == "uint8" or tensor.dtype.startswith("float"))


def _vary(value: Any, tensor: TensorSpec, random: np.random.Generator) -> Any:
    if not _can_vary(tensor):
        return value
    array = np.asarray(value)
    if tensor.dtype == "uint8":
        return array ^ random.integers(0, 2, array.shape, np.uint8)
    scale = 1e-3 * (float(np.abs(array).mean()) or 1.0)
    return (array + scale * random.standard_normal(array.shape)).astype(array.dtype)
