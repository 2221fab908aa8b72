"""Play episodes, spread over child processes; each opens the bundle once.

The environment is a user's code: it runs in children alone, however many, and one that ends its process, prints or
changes the directory does that there (see ``vlatool.user_code.children``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vlatool.accuracy.outcome import Outcome
from vlatool.accuracy.success import Success
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, VlatoolError
from vlatool.evaluate._controls import Array, Blind, answers_of
from vlatool.evaluate._environment import GUIDE, World
from vlatool.files.printable import message_of
from vlatool.module.factory import call_factory, exits_caught
from vlatool.runtime.chunks import ChunkQueue
from vlatool.runtime.policy import FIRST_RUN_S, Policy
from vlatool.stage.base import Context
from vlatool.user_code.children import spread

STEP_LIMIT = 100_000
PRELOAD = ("numpy", "onnxruntime", __name__)


@dataclass(frozen=True)
class Job:
    """Some episodes of one task."""

    environment: str
    folder: str
    task: str
    seeds: tuple[int, ...]
    instruction: str = "right"
    control: str = ""


def run_jobs(bundle: Bundle, jobs: list[Job], engine: str, context: Context) -> list[Outcome]:
    """Play all episodes and return their outcomes in the order of the jobs, whatever the number of workers.

    Raises:
        DataError: when the environment fails or does not fit the policy's spec.
        SourceError: when it ends the process that it runs in.
    """
    opening = {"bundle": str(bundle.path.absolute()), "engine": engine, "limit": STEP_LIMIT}
    requests = [{**opening, "job": asdict(job)} for job in jobs]
    about = jobs[0].environment.rpartition(":")[0] if jobs else ""
    here = f"{__name__}:"
    found = spread(f"{here}play", requests, context.workers, context.tell, about, PRELOAD, last=f"{here}close")
    with contextlib.closing(found):
        played = (_played(part, job) for part, job in zip(found, jobs, strict=True))
        return _collect(played, len(jobs), context)


def _played(found: Any, job: Job) -> list[Outcome]:
    """Return what a child says of the episodes of a job."""
    try:
        return [Outcome(job.task, int(seed), bool(success), int(steps)) for seed, success, steps in found]
    except (TypeError, ValueError) as error:
        raise DataError(f"The process that played '{job.task}' answers what are no episodes.") from error


def _collect(results: Any, count: int, context: Context) -> list[Outcome]:
    outcomes: list[Outcome] = []
    for number, part in enumerate(results):
        outcomes += part
        done = sum(outcome.success for outcome in outcomes) / len(outcomes)
        context.tell(f"{len(outcomes)} episodes, {done:.1%} succeed", (number + 1) / count)
    return outcomes


class BoundedQueue(ChunkQueue):
    """A queue whose policy is stopped when an inference takes longer than any that a robot could use."""

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this control step.

        Raises:
            UsageError, DataError, GraphError: as ``ChunkQueue.act`` does, and when an inference takes too long.
        """
        with self.policy.stopped_after(FIRST_RUN_S):
            return super().act(observation)


class Worker:
    """What a child process keeps between jobs: the policy and the environment of the current task."""

    def __init__(self, path: str, engine: str) -> None:
        policy = Policy.open(Bundle.open(Path(path)), engine=engine, threads=1, seed=0)
        policy.warm_up(1)
        self.queue = BoundedQueue(policy)
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

    def play(self, job: Job, limit: int = STEP_LIMIT) -> list[Outcome]:
        """Play the episodes of a job."""
        world = World(self.environment(job), job.task, self.queue.policy.spec)
        return [_episode(world, self._actor(job.control, seed), job.task, seed, limit) for seed in job.seeds]

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


_worker: Worker | None = None


def play(request: Mapping[str, Any], _tell: Callable[[str, float | None], None]) -> list[list[Any]]:
    """Play the episodes of a job in this process: seed, success and steps of each."""
    global _worker
    if _worker is None:
        _worker = Worker(request["bundle"], request["engine"])
    job = Job(**{**request["job"], "seeds": tuple(request["job"]["seeds"])})
    return [[each.seed, each.success, each.steps] for each in _worker.play(job, request["limit"])]


def close(_request: Mapping[str, Any], _tell: Callable[[str, float | None], None]) -> None:
    """Close what is open in this process."""
    global _worker
    if _worker is not None:
        _worker.close()
    _worker = None


def _episode(world: World, queue: ChunkQueue | Blind, task: str, seed: int, limit: int) -> Outcome:
    try:
        with exits_caught(f"the environment of task '{task}', at seed {seed},"):
            observation = world.reset(seed)
            queue.reset()
            told = Success()
            for step in range(1, limit):
                action = _acted(queue, observation, f"task '{task}' at seed {seed}, step {step},")
                observation, over, info = world.step(action.item() if action.ndim == 0 else action)
                told.look(info)
                if over:
                    return Outcome(task, seed, told.at_the_end(task, seed), step)
    except VlatoolError:
        raise
    except Exception as error:  # the seam: a user's environment may raise anything
        raise DataError(
            f"The environment of task '{task}' failed at seed {seed}: {type(error).__name__}: {message_of(error)}."
        ) from error
    raise DataError(f"The environment of task '{task}' did not end within {limit} steps at seed {seed}.")


def _acted(queue: ChunkQueue | Blind, observation: Mapping[str, Any], where: str) -> Array:
    """Return the action; an observation that the policy does not take is the environment's."""
    try:
        return queue.act(observation)
    except DataError as error:
        raise DataError(f"The environment, in {where} gives what the policy does not take: {error.message}",
                        error.fix or f"let it give what the policy was trained on; {GUIDE}") from error  # fmt: skip
