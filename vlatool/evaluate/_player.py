"""Plays the episodes of an evaluation with a bundle, and keeps the outcomes so far."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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


@dataclass
class Player:
    """Plays jobs with a bundle, and tells how it does beside the one that it is paired with.

    Args:
        latency: Latency of its actions in the control loop; none when None.
        engine: Engine of the runtime; the bundle's own when empty.
        most: Largest number of episodes that it will play.
        baseline: The player of the same episodes before, if there is one.
        store: Outcomes of an interrupted run, and of this one; none are stored when None.
    """

    bundle: Bundle
    latency: Measurement | None
    engine: str
    context: Context
    most: int
    baseline: Player | None = None
    store: Store | None = None
    outcomes: list[Outcome] = field(default_factory=list)

    def __call__(self, jobs: list[EpisodesJob]) -> list[Outcome]:
        """Play further episodes; one that is only to be shown was counted before."""
        if jobs[0].show:
            here = replace(self.context, launcher=PROCESSES, workers=1)  # pictures stay on this machine
            context, store = (here, None) if jobs[0].film else (self.context, self.store)
            return run_jobs(self.bundle, with_latency(jobs, self.latency), self.engine, context, store=store)
        tally = Tally(self.most, self.baseline.outcomes if self.baseline else ())
        tally.add(self.outcomes)
        jobs = with_latency(jobs, self.latency)
        outcomes = run_jobs(self.bundle, jobs, self.engine, self.context, tally, self.store)
        self.outcomes += outcomes
        return outcomes
