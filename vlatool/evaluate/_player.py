"""Who plays the episodes of an evaluation: a bundle, how late its actions come, and what it has played so far."""

from __future__ import annotations

from dataclasses import replace

from vlatool.accuracy.paired import Outcome
from vlatool.bundle.bundle import Bundle
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.episodes.progress import Tally
from vlatool.evaluate._late import late
from vlatool.report import Measurement
from vlatool.stage.base import Context
from vlatool.workers import PROCESSES


class Player:
    """Plays jobs with a bundle, and tells how it does beside the one that it is paired with.

    Args:
        bundle: Who acts.
        wait: How late its actions come; at once when None.
        engine: Of the runtime; the bundle's own when empty.
        context: Progress, which says whose it is, and workers.
        most: Episodes that it will play at most.
        baseline: Who plays the same episodes before.
    """

    def __init__(
        self,
        bundle: Bundle,
        wait: Measurement | None,
        engine: str,
        context: Context,
        most: int,
        baseline: Player | None = None,
    ) -> None:
        self._bundle, self._wait, self._engine, self._context = bundle, wait, engine, context
        self._most, self._baseline = most, baseline
        self.outcomes: list[Outcome] = []

    def __call__(self, jobs: list[EpisodesJob]) -> list[Outcome]:
        """Play further episodes; one that is only to be shown was counted before."""
        if jobs[0].show:
            here = replace(self._context, launcher=PROCESSES, workers=1, store=None)  # pictures stay on this machine
            context = here if jobs[0].film else self._context
            return run_jobs(self._bundle, late(jobs, self._wait), self._engine, context)
        tally = Tally(self._most, self._baseline.outcomes if self._baseline else ())
        tally.add(self.outcomes)
        outcomes = run_jobs(self._bundle, late(jobs, self._wait), self._engine, self._context, tally)
        self.outcomes += outcomes
        return outcomes
