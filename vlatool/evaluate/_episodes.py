"""Play episodes, spread over worker processes; each worker opens the bundle once."""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle import Bundle
from vlatool.errors import DataError, VlatoolError
from vlatool.evaluate._controls import Array, Blind, answers_of
from vlatool.evaluate._success import Success
from vlatool.runtime.chunks import ChunkQueue
from vlatool.runtime.policy import Policy
from vlatool.sources._factory import call_factory
from vlatool.stage import Context

STEP_LIMIT = 100_000


@dataclass(frozen=True)
class Job:
    """Some episodes of one task."""

    environment: str
    folder: str
    task: str
    seeds: tuple[int, ...]
    instruction: str = "right"
    control: str = ""


@dataclass(frozen=True)
class Outcome:
    """How one episode ended: after ``steps`` control steps."""

    task: str
    seed: int
    success: bool
    steps: int


def run_jobs(bundle: Bundle, jobs: list[Job], engine: str, context: Context) -> list[Outcome]:
    """Play all episodes and return their outcomes in the order of the jobs, whatever the number of workers.

    Raises:
        DataError: when the environment fails or does not fit the policy's spec.
    """
    arguments = (str(bundle.path), engine)
    if context.workers == 1:
        worker = _Worker(*arguments)
        try:
            return _collect((worker.play(job) for job in jobs), len(jobs), context)
        finally:
            worker.close()
    spawn = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(context.workers, spawn, _open, arguments)
    try:
        return _collect(pool.map(_play, jobs), len(jobs), context)
    except concurrent.futures.process.BrokenProcessPool as error:
        raise DataError(
            "A worker process died while it played episodes.", "look at the memory, or run with --workers 1 to see why"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _collect(results: Any, count: int, context: Context) -> list[Outcome]:
    outcomes: list[Outcome] = []
    for number, part in enumerate(results):
        outcomes += part
        done = sum(outcome.success for outcome in outcomes) / len(outcomes)
        context.tell(f"{len(outcomes)} episodes, {done:.1%} succeed", (number + 1) / count)
    return outcomes


class _Worker:
    """What a worker process keeps between jobs: the policy and the environment of the current task."""

    def __init__(self, path: str, engine: str) -> None:
        self.queue = ChunkQueue(Policy.open(Bundle.open(Path(path)), engine=engine, threads=1, seed=0))
        self._answers: Array | None = None
        self._key: tuple[str, ...] = ()
        self._environment: Any = None

    def environment(self, job: Job) -> Any:
        """Return the environment of a job; one is open at a time, since some renderers allow no more."""
        key = (job.environment, job.folder, job.task, job.instruction)
        if key != self._key:
            self.close()
            arguments = {"task": job.task, **({} if job.instruction == "right" else {"instruction": job.instruction})}
            self._environment = call_factory(job.environment, Path(job.folder), arguments)
            self._key = key
        return self._environment

    def play(self, job: Job) -> list[Outcome]:
        """Play the episodes of a job."""
        environment = self.environment(job)
        return [_episode(environment, self._actor(job.control, seed), job.task, seed) for seed in job.seeds]

    def _actor(self, control: str, seed: int) -> ChunkQueue | Blind:
        """Return who acts: the policy, or a control that does not look."""
        if not control:
            return self.queue
        if self._answers is None:
            self._answers = answers_of(self.queue.policy)
        return Blind(control, self.queue.policy.spec.action, self._answers, seed)

    def close(self) -> None:
        """Close the open environment; one that fails to close has done its work all the same."""
        environment, self._environment, self._key = self._environment, None, ()
        if environment is not None:
            with contextlib.suppress(Exception):
                environment.close()


_worker: _Worker | None = None


def _open(path: str, engine: str) -> None:
    global _worker
    _worker = _Worker(path, engine)


def _play(job: Job) -> list[Outcome]:
    if _worker is None:
        raise RuntimeError("the worker was not opened")
    return _worker.play(job)


def _episode(environment: Any, queue: ChunkQueue | Blind, task: str, seed: int) -> Outcome:
    try:
        observation, _ = environment.reset(seed=seed)
        queue.reset()
        told = Success()
        for step in range(1, STEP_LIMIT):
            action = queue.act(observation)
            observation, _, terminated, truncated, info = environment.step(
                action.item() if action.ndim == 0 else action
            )
            told.look(info)
            if terminated or truncated:
                return Outcome(task, seed, told.at_the_end(task, seed), step)
    except VlatoolError:
        raise
    except Exception as error:  # the seam: a user's environment may raise anything
        raise DataError(
            f"The environment of task '{task}' failed at seed {seed}: {type(error).__name__}: {error}."
        ) from error
    raise DataError(f"The environment of task '{task}' did not end within {STEP_LIMIT} steps at seed {seed}.")
