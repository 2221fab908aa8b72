"""Processes that time both bundles, measured when a claim asks for one more."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from vlatool.gate.inputs import TIMING, Inputs
from vlatool.measurement.pairs import PairJob, Pairs, measure_pairs
from vlatool.measurement.turns import observation_count
from vlatool.stage.base import Context


@dataclass
class Timed:
    """Processes that were measured so far.

    Args:
        job: question to each process; process n has the seed ``job.seed + n``.
        timeout: seconds that a process may take.
        inputs: observations that the bundles are called with; drawn by each process from the baseline's spec when None.
    """

    job: PairJob
    context: Context
    timeout: float | None = None
    inputs: Inputs | None = None
    pairs: list[Pairs] = field(default_factory=list)

    def process(self, number: int) -> Pairs:
        """Return what a process found; measures it when it is the next one.

        Raises:
            GraphError: when a bundle cannot be run, or the process takes longer than the timeout.
        """
        if number == len(self.pairs):
            self.context.progress(f"process {number + 1}: both bundles, call by call", None)
            self.pairs.append(self._measure(replace(self.job, seed=self.job.seed + number), number))
        return self.pairs[number]

    def _measure(self, job: PairJob, number: int) -> Pairs:
        if self.inputs is None:
            return measure_pairs(job, self.timeout)
        with self.inputs.file(observation_count(job.pairs), TIMING, number) as path:
            return measure_pairs(replace(job, observations=str(path)), self.timeout)

    def at_threads(self, threads: int) -> Timed:
        """Return the same with another number of threads, and nothing measured yet."""
        return replace(self, job=replace(self.job, threads=threads), pairs=[])

    def processes(self) -> list[int]:
        """Return the process of each call."""
        return [number for number, pairs in enumerate(self.pairs) for _ in pairs.candidate_ms]

    def calls(self, which: str) -> list[float]:
        """Return the milliseconds of all calls of ``baseline`` or ``candidate``."""
        return [value for pairs in self.pairs for value in getattr(pairs, f"{which}_ms")]
