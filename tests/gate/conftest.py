"""Processes that are made up: a claim is examined on the log ratios and calls that a test wants."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from vlatool.gate import timing_processes as timed_module
from vlatool.gate.timing_processes import Timed
from vlatool.measurement.pairs import PairJob, Pairs
from vlatool.stage.base import Context

MakeTimed = Callable[..., Timed]


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch) -> MakeTimed:
    """A function that makes processes: slowdown of the candidate, its milliseconds, spread between processes."""

    def make(slowdown: float = 0.0, ms: float = 5.0, spread: float = 0.02, calls: int = 150) -> Timed:
        def measured(job: PairJob, timeout: float | None) -> Pairs:
            random = np.random.default_rng(job.seed)
            base = ms * np.exp(0.05 * random.normal(size=calls))
            ratio = (1 + slowdown) * math.exp(spread * random.normal())
            return Pairs(tuple(base.tolist()), tuple((ratio * random.permutation(base)).tolist()))

        monkeypatch.setattr(timed_module, "measure_pairs", measured)
        return Timed(PairJob("a", "b"), Context())

    return make
