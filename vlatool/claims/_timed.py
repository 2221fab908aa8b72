"""Processes that time both bundles, measured when a claim asks for one more."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from vlatool.benchmark._pairs import Job, Pairs, measure_pairs
from vlatool.stage import Context


@dataclass
class Timed:
    """The processes that were measured so far.

    Args:
        job: What each measures; process n has the seed ``job.seed + n``.
        context: For progress.
        timeout: Seconds that a process may take.
    """

    job: Job
    context: Context
    timeout: float | None = None
    pairs: list[Pairs] = field(default_factory=list)

    def log_ratio(self, number: int) -> float:
        """Return the log ratio of a process, candidate over baseline; measures it when it is the next one.

        Raises:
            GraphError: when a bundle cannot be run, or the process takes longer than the timeout.
        """
        if number == len(self.pairs):
            self.context.tell(f"process {number + 1}: both bundles, call by call", None)
            self.pairs.append(measure_pairs(replace(self.job, seed=self.job.seed + number), self.timeout))
        return self.pairs[number].log_ratio

    def processes(self) -> list[int]:
        """Return the process of each call."""
        return [number for number, pairs in enumerate(self.pairs) for _ in pairs.candidate_ms]

    def calls(self, which: str) -> list[float]:
        """Return the milliseconds of all calls of ``baseline`` or ``candidate``."""
        return [value for pairs in self.pairs for value in getattr(pairs, f"{which}_ms")]
