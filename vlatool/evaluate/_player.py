"""Plays the episodes of an evaluation with a bundle, and keeps the outcomes so far."""

from __future__ import annotations

from dataclasses import replace

from vlatool.accuracy.success_comparison import Outcome
from vlatool.bundle.bundle import Bundle
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.episodes.progress import Tally
from vlatool.evaluate._loop_latency import with_latency
from vlatool.files.resumable_work import Store
from vlatool.report import Measurement
from vlatool.stage.base import Context
from vlatool.workers import PROCESSES


class Player:
    """Plays jobs with a bundle, and tells how it does beside the one that it is paired with.

    Args:
        latency: Latency of its actions in the control loop; none when None.
        engine: Engine of the runtime; the bundle's own when empty.
        most: Largest number of episodes that it will play.
        baseline: The player of the same episodes before, if there is one.
        store: Outcomes of an interrupted run, and of this one; none are stored when None.
    """

    def __init__(
        self, bundle: Bundle, latency: Measurement | None, engine: str, context: Context, most: int,
        baseline: Player | None = None, store: Store | None = None
    ) -> None:  # fmt: skip
        self._bundle, self._latency, self._engine, self._context = bundle, latency, engine, context
        self._most, self._baseline, self._store = most, baseline, store
        self.outcomes: list[Outcome] = []

    def __call__(self, jobs: list[EpisodesJob]) -> list[Outcome]:
        """Play further episodes; one that is only to be shown was counted before."""
        if jobs[0].show:
            here = replace(self._context, launcher=PROCESSES, workers=1)  # pictures stay on this machine
            context, store = (here, None) if jobs[0].film else (self._context, self._store)
            return run_jobs(self._bundle, with_latency(jobs, self._latency), self._engine, context, store=store)
        tally = Tally(self._most, self._baseline.outcomes if self._baseline else ())
        tally.add(self.outcomes)
        jobs = with_latency(jobs, self._latency)
        outcomes = run_jobs(self._bundle, jobs, self._engine, self._context, tally, self._store)
        self.outcomes += outcomes
        return outcomes
