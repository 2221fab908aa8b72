"""The calls of a process that times two bundles: which observation is next, and what both answer.

Half of the observations of a block, another half each time, are given to the bit as they were recorded or drawn: a
robot's inputs are exact where a gripper is open or a pixel is black, and a graph can tell. The others are varied anew
in every call, so that most calls have bits that were never seen: an answer that is remembered is of little use. The
same observation, with the same bits and the same noise, goes to both bundles. Each observation of a block is called
three times but never twice in a row, so that however early a slow policy is cut off, its latency is a median, of exact
calls or of varied ones. Afterwards fresh sessions answer some of the timed calls again.

A place is what a call was made with: an observation, exact or varied (``variant_index``).
"""

from __future__ import annotations

import gc
import math
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import keeps_values
from vlatool.data import RANDOM_KIND, RECORDED_KIND, Drawer, Drawn, read_drawn
from vlatool.errors import GraphError, VlatoolError
from vlatool.measurement.answers import Answers, vary_observation
from vlatool.measurement.child import serve
from vlatool.measurement.pairs import FEWEST, PairJob, Pairs, medians
from vlatool.runtime import Policy, load
from vlatool.runtime.arguments import RECORD
from vlatool.runtime.program import draw

WARMUP_MS = 200.0
"""How long each bundle runs before its first call that counts, at least ``PairJob.warmup`` calls."""
BLOCK, REPEATS = 10, 3
"""Observations of a block, and calls of each."""
SUSPECT = 1.25
"""Candidate over baseline from which an observation is called further times."""
CONFIRM = 20
"""Those further pairs."""
MAX_REPLAYED = 24
"""Timed answers that a fresh session gives again."""


@dataclass(frozen=True)
class Call:
    """An observation with the noise of its inference, and what the baseline and the candidate answered."""

    observation: Mapping[str, Any]
    noise: Mapping[str, Any] | None
    outputs: tuple[Mapping[str, Any], Mapping[str, Any]]


class Turns:
    """Both policies, open, and the observations of a process; raises VlatoolError when one cannot be loaded."""

    def __init__(self, job: PairJob) -> None:
        self.job = job
        self.order = random.Random(job.seed)
        self.noise = np.random.default_rng([job.seed, 1])
        baseline = Bundle.open(job.baseline)
        self.pool = pool_of(job, baseline)
        self.spec = baseline.manifest.spec
        self.steps = baseline.manifest.program
        self.policies: list[Any] = [None, None]
        for which in self.order.sample((0, 1), 2):
            self.policies[which] = self._load(which)
            self._warm_up(self.policies[which])
        self.taken: tuple[list[float], list[float]] = ([], [])
        self.places: list[int] = []
        self.unusable: set[int] = set()
        self.kept: list[Call] = []

    def measure(self) -> Pairs:
        """Time all pairs, look again at what seemed slow, and replay."""
        gc.collect()
        gc.freeze()
        gc.disable()
        self._time()
        gc.enable()
        if not self.places:
            raise GraphError(
                f"{self.job.baseline} answers none of the observations that were drawn for it.",
                "see what it says of one: vlatool inspect BASELINE --probe; name a baseline that runs",
            )
        slow, slow_input = self._confirm()
        self.policies = [None, None]
        looked, strays = self._replay(1)
        unsteady = self._replay(0)[1] if strays else 0
        baseline, candidate = map(tuple, self.taken)
        return Pairs(baseline, candidate, tuple(self.places), slow, slow_input, looked, strays, unsteady)

    def _load(self, which: int) -> Policy:
        path = (self.job.baseline, self.job.candidate)[which]
        return load_policy(path, self.job)

    def _warm_up(self, policy: Policy) -> None:
        begun, number = time.monotonic(), 0
        while number < self.job.warmup or (time.monotonic() - begun) * 1e3 < WARMUP_MS:
            drawn = self.pool[number % len(self.pool)]
            try:
                policy.infer(drawn.observation)
            except GraphError:  # told where it is timed, if the other one answers
                policy.reset()
            number += 1

    def _time(self) -> None:
        begun, number, called = time.monotonic(), 0, 0
        while called < self.job.pairs:
            if called >= FEWEST and time.monotonic() - begun > self.job.seconds:
                break
            block = [(number * BLOCK + offset) % len(self.pool) for offset in range(min(BLOCK, len(self.pool)))]
            block = halve(block, self.order)
            called += self._time_block(sequence(block, self.order)[: self.job.pairs - called])
            number += 1

    def _time_block(self, indices: Sequence[int]) -> int:
        """Time a block and keep its calls for the replay, or some of them; return how many there were."""
        for policy in self.policies:
            policy.reset()
        calls = [call for index in indices if (call := self._pair(index)) is not None]
        if keeps_values(self.steps):  # what they answer depends on all that came before: one block, from its start
            whole = len(calls) == len(indices)
            self.kept = calls if whole and (not self.kept or self.order.random() < 0.5) else self.kept
        else:
            self.kept += self.order.sample(calls, min(len(calls), REPEATS + 2))
        return len(indices)

    def _pair(self, index: int) -> Call | None:
        """Time both with an observation, exact or varied; None when the baseline cannot answer it."""
        if index in self.unusable:
            return None
        observation, noise = self._variant(index)
        took = [0.0, 0.0]
        outputs: list[dict[str, Any]] = [{}, {}]
        failed: dict[int, GraphError] = {}
        for which in self.order.sample((0, 1), 2):
            infer = self.policies[which].infer
            start = time.perf_counter_ns()
            try:
                action = infer(observation, noise=noise)
            except GraphError as error:
                failed[which] = error
                continue
            took[which] = (time.perf_counter_ns() - start) / 1e6
            outputs[which] = {name: np.array(value) for name, value in action.outputs.items()}
        if failed:
            self._skip(index, failed)
            return None
        self.places.append(index)
        for which in (0, 1):
            self.taken[which].append(took[which])
        return Call(observation, noise, (outputs[0], outputs[1]))

    def _skip(self, index: int, failed: Mapping[int, GraphError]) -> None:
        """Leave out what the baseline cannot answer."""
        if 0 not in failed:
            what = f"{self.job.candidate} fails where the baseline answers ({self._describe(index)})"
            raise GraphError(f"{what}: {failed[1].message}", failed[1].fix)
        self.unusable.add(index)
        for policy in self.policies:
            policy.reset()

    def _variant(self, index: int) -> tuple[dict[str, Any], dict[str, Any] | None]:
        number, exact = observation_of(index)
        drawn = self.pool[number].observation
        observation = dict(drawn) if exact else vary_observation(drawn, self.spec, self.noise)
        noise = {name: draw(wanted, self.noise) for step in self.steps for name, wanted in step.noise.items()}
        return observation, noise or None

    def _describe(self, index: int) -> str:
        number, exact = observation_of(index)
        return describe(self.pool[number], exact)

    def _confirm(self) -> tuple[tuple[float, ...], str]:
        """Time further pairs of the place (an observation, exact or varied) where the candidate seemed the slowest."""
        mine, theirs = (medians(self.taken[which], self.places) for which in (1, 0))
        index = max(mine, key=lambda index: mine[index] / theirs[index])
        if mine[index] / theirs[index] < SUSPECT:
            return (), ""
        before = len(self.places)
        logs: list[float] = []
        for _ in range(CONFIRM):
            self._pair(self.order.choice(self.places[:before]))  # another one between them
            if self._pair(index) is not None:
                logs.append(math.log(self.taken[1][-1] / self.taken[0][-1]))
        del self.places[before:], self.taken[0][before:], self.taken[1][before:]
        return tuple(logs), f"{self._describe(index)}: {math.exp(median(logs)):.2f}x" if logs else ""

    def _replay(self, which: int) -> tuple[int, int]:
        """Let a fresh session answer the kept calls; return how many, and how many it answers otherwise."""
        policy = self._load(which)
        keeps = keeps_values(self.steps)
        calls = self.kept if keeps else self.order.sample(self.kept, min(MAX_REPLAYED, len(self.kept)))
        answers = Answers([call.outputs[which] for call in calls])
        for number, call in enumerate(calls):
            if number == 0 or not keeps:
                policy.reset()
            answers.look(number, policy.infer(call.observation, noise=call.noise).outputs)
        return answers.looked, answers.strays


def load_policy(path: str, job: PairJob, traced: bool = False) -> Policy:
    """Load a bundle as a robot does: every file is hashed, and the golden action is computed.

    What a stage found to be wrong was looked at by the gate before.

    Args:
        traced: Whether the policy is to tell what the engine ran.

    Raises:
        VlatoolError: what ``load`` raises, with the bundle's path.
    """
    try:
        known = [finding["name"] for finding in Bundle.open_lazily(path).manifest.findings]
        proof = RECORD if traced else ""
        return load(path, engine=job.engine, threads=job.threads, seed=job.seed, accept=known, engine_proof=proof)
    except VlatoolError as error:
        if path in error.message:
            raise
        raise type(error)(f"{path}: {error.message}", error.fix) from error


def pool_of(job: PairJob, baseline: Bundle) -> list[Drawn]:
    """Return the observations of a process: those of its file, else drawn from the baseline's spec alone."""
    if job.observations:
        return read_drawn(Path(job.observations))
    return Drawer(baseline).draw(observation_count(job.pairs), np.random.default_rng([job.seed, 2]))


def observation_count(pairs: int) -> int:
    """Return how many observations so many pairs take."""
    return max(BLOCK, math.ceil(pairs / REPEATS))


def variant_index(number: int, exact: bool) -> int:
    """Return the place of an observation: ``exact`` when it is given to the bit as it was drawn, else varied."""
    return 2 * number + exact


def observation_of(index: int) -> tuple[int, bool]:
    """Return the number of a place's observation, and whether it is given exactly."""
    return index // 2, bool(index % 2)


def halve(numbers: Sequence[int], order: random.Random) -> list[int]:
    """Return the places of observations, a random half of them exact; which half is the larger is drawn as well."""
    exact = set(order.sample(numbers, (len(numbers) + order.randrange(2)) // 2))
    return [variant_index(number, number in exact) for number in numbers]


def sequence(pool: Sequence[int], order: random.Random) -> list[int]:
    """Return each place ``REPEATS`` times in random order, never twice in a row unless there is one alone."""
    indices: list[int] = []
    for _ in range(REPEATS):
        part = order.sample(pool, len(pool))
        if indices and part[0] == indices[-1]:
            part.reverse()
        indices += part
    return indices


def describe(drawn: Drawn, exact: bool = True) -> str:
    """Return an observation in a few words; one that is not ``exact`` is varied."""
    texts = [f"{name} {value!r}" for name, value in drawn.observation.items() if isinstance(value, str)]
    kind = {RECORDED_KIND: "as recorded", RANDOM_KIND: "drawn"}.get(drawn.kind, "recorded otherwise")
    return ", ".join([kind, *([] if exact else ["slightly varied"]), *texts])


def run_job(job: PairJob) -> Pairs:
    """Measure in this process."""
    return Turns(job).measure()


if __name__ == "__main__":
    serve(PairJob, run_job)
