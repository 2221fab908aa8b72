"""Two bundles timed call by call in one fresh process: the unit of which a gate takes several.

``python -m vlatool.benchmark._pairs`` reads one line of JSON (the fields of ``Job``) and prints one (those of
``Pairs``). Both bundles are in one process and take turns in random order, so that a slow phase of the machine hits
both; the process is fresh, because how memory happens to lie makes one process faster than the next.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import math
import random
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from vlatool.benchmark._child import answer, ask
from vlatool.processes import die_with_parent

WARMUP_MS = 200.0
"""How long each bundle runs before its first call that counts, at least ``Job.warmup`` calls."""


@dataclass(frozen=True)
class Job:
    """What a process measures.

    Args:
        baseline, candidate: Directories of bundles.
        engine: Of the runtime; that which each bundle was made for when empty.
        threads: Intra-op threads.
        warmup: Calls of each before the first that counts.
        pairs: Calls of each that count.
        seconds: After which no further pair begins, once ``FEWEST`` are measured.
        seed: Of the order in which the bundles are loaded and called.
    """

    baseline: str
    candidate: str
    engine: str = ""
    threads: int = 1
    warmup: int = 20
    pairs: int = 150
    seconds: float = 10.0
    seed: int = 0


FEWEST = 30
"""Pairs that are measured however long they take: a median of fewer says little."""


@dataclass(frozen=True)
class Pairs:
    """What a process found.

    Args:
        baseline_ms, candidate_ms: Milliseconds of each call, in the order of the pairs.
    """

    baseline_ms: tuple[float, ...]
    candidate_ms: tuple[float, ...]

    @property
    def log_ratio(self) -> float:
        """Natural logarithm of the candidate's median over the baseline's: above 0 is slower."""
        return math.log(median(self.candidate_ms) / median(self.baseline_ms))


def measure_pairs(job: Job, timeout: float | None = None) -> Pairs:
    """Measure in a fresh process.

    Raises:
        VlatoolError: what a bundle raises; GraphError when the process ends or takes longer than ``timeout`` seconds.
    """
    about = f"{job.candidate} beside {job.baseline}"
    found = ask("vlatool.benchmark._pairs", (), json.dumps(dataclasses.asdict(job)), about, timeout)
    return Pairs(tuple(found["baseline_ms"]), tuple(found["candidate_ms"]))


def run_job(job: Job) -> Pairs:
    """Measure in this process."""
    from vlatool.bundle import Bundle
    from vlatool.data import observations_for
    from vlatool.runtime.policy import Policy

    order = random.Random(job.seed)
    paths = (job.baseline, job.candidate)
    policies: list[Any] = [None, None]
    observations: list[Sequence[Any]] = [(), ()]
    for which in order.sample((0, 1), 2):
        bundle = Bundle.open(Path(paths[which]), verify=False)
        policies[which] = Policy.open(bundle, engine=job.engine, threads=job.threads, seed=0)
        observations[which] = observations_for(bundle, 32)
        _warm_up(policies[which], observations[which], job.warmup)
    gc.collect()
    gc.freeze()
    gc.disable()
    taken: tuple[list[float], list[float]] = ([], [])
    begun = time.monotonic()
    for number in range(job.pairs):
        if number >= FEWEST and time.monotonic() - begun > job.seconds:
            break
        for which in order.sample((0, 1), 2):
            observation = observations[which][number % len(observations[which])]
            infer = policies[which].infer
            start = time.perf_counter_ns()
            infer(observation)
            taken[which].append((time.perf_counter_ns() - start) / 1e6)
    return Pairs(tuple(taken[0]), tuple(taken[1]))


def _warm_up(policy: Any, observations: Sequence[Any], calls: int) -> None:
    begun, number = time.monotonic(), 0
    while number < calls or (time.monotonic() - begun) * 1e3 < WARMUP_MS:
        policy.infer(observations[number % len(observations)])
        number += 1


if __name__ == "__main__":
    die_with_parent()
    answer(lambda: dataclasses.asdict(run_job(Job(**json.loads(sys.stdin.readline())))))
