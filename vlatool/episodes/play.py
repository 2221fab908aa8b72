"""Play episodes, in a child process that opens the bundle once; ``jobs`` spreads them over several.

The environment is a user's code: it runs in children alone, however many, and one that ends its process, prints or
changes the directory does that there (see ``vlatool.user_code.children``).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.accuracy.success import Success
from vlatool.accuracy.success_comparison import Outcome
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec
from vlatool.data import observations_for
from vlatool.episodes.body import Body, series_of
from vlatool.episodes.controls import ANSWERED_OBSERVATIONS, Blind, answers_of
from vlatool.episodes.disturbances import BUILT_IN_DISTURBANCES, DisturbedController
from vlatool.episodes.environment import GUIDE, World, time_limit
from vlatool.episodes.faults import error_context, under_way
from vlatool.episodes.film import world_of
from vlatool.episodes.frames import FrameRecorder, Noisy
from vlatool.errors import DataError, require
from vlatool.files.messages import from_json, to_json
from vlatool.files.printable import one_line
from vlatool.module.factory import call_factory
from vlatool.motion.measure import measure_episode
from vlatool.runtime.control import build_controller
from vlatool.runtime.interface import Array, Controller
from vlatool.runtime.policy import FIRST_RUN_S, BundlePolicy
from vlatool.user_code.children import OnProgress

OUTCOME_PREFIX = "ended: "
"""How the progress begins that says how an episode ended: what comes after it in its job may never end."""
SLICE = 10
"""Episodes of one task that a worker plays at a time."""
STEP_LIMIT = 100_000
MAX_INSTRUCTION_LENGTH = 200
"""Characters of an instruction that are kept."""
EVALUATION_SEEDS = 5_000_000
"""First seed of the episodes that policies are judged by; those that they are trained on have smaller ones."""
RECORDINGS = "data/"
"""What of a bundle no episode needs."""
PRELOAD = ("numpy", "onnxruntime", __name__)


@dataclass(frozen=True)
class EpisodesJob:
    """Some episodes of one task.

    Args:
        environment: ``path.py:make`` or ``package.module:make``.
        control: Actions that do not look, in the place of the policy's; none when empty.
        noise: What is added to actions, so that a policy that is trained on the episodes has seen mistakes: the share
            of each action's standard deviation; for discrete actions, how often a random one is taken.
        record: Folder for what the policy was given at each inference, ``NAME.npy`` for each input; nothing is kept
            when empty.
        disturb: Disturbance of the environment, or of what the policy sees (``episodes/disturbances.py``).
        strength: strength of the disturbance; 1 is what an ordinary day brings.
        latency_ms: How late actions come; 0 for at once.
        controller: Names of the controller and of wrappers; vlatool's own when empty (``vlatool.runtime.control``).
        show: Whether the outcomes hold the path and the actions of each step.
        film: Folder for pictures of the episode, of which there is one then; none are taken when empty.
        timeout_s: Seconds that a call of the environment may take; the limit ``environment_seconds`` when 0.
    """

    environment: str
    folder: str
    task: str
    seeds: tuple[int, ...]
    instruction: str = "right"
    control: str = ""
    noise: float = 0.0
    record: str = ""
    disturb: str = ""
    strength: float = 1.0
    latency_ms: float = 0.0
    controller: tuple[str, ...] = ()
    show: bool = False
    film: str = ""
    timeout_s: float = 0.0


@dataclass(frozen=True)
class Request:
    """Episodes that a child plays with a bundle, each of at most ``limit`` control steps."""

    bundle: str
    engine: str
    limit: int
    job: EpisodesJob


@dataclass(frozen=True)
class Played:
    """What a child answers: how the episodes of a job ended, in the order of its seeds."""

    outcomes: tuple[Outcome, ...]


def jobs_for(job: EpisodesJob, tasks: Sequence[str], episodes: int, first_seed: int) -> list[EpisodesJob]:
    """Return jobs of ``SLICE`` episodes at most: so many in all, spread evenly over tasks, of the same seeds.

    Args:
        job: What all of them have in common; task and seeds are of no account.
        episodes: Rounded up to a multiple of the tasks.
        first_seed: first seed of each task.
    """
    end = first_seed - (-episodes // len(tasks))
    starts = range(first_seed, end, SLICE)
    return [
        replace(job, task=task, seeds=tuple(range(start, min(end, start + SLICE))))
        for task in tasks
        for start in starts
    ]


class Worker:
    """What a child process keeps between jobs: the policy and the environment of the current task."""

    def __init__(self, path: str, engine: str) -> None:
        self._bundle = Bundle.open_lazily(path)
        policy = _open_policy(self._bundle, engine)
        self.policy = FrameRecorder(policy, policy.encode)
        self._answers: Array | None = None
        self._key: tuple[str, ...] = ()
        self._environment: Any = None
        self._job: EpisodesJob | None = None
        """The last one of the open environment."""
        self._home = Path.cwd()

    def environment(self, job: EpisodesJob) -> Any:
        """Return the environment of a job; one is open at a time, since some renderers allow no more."""
        key = (job.environment, job.folder, job.task, job.instruction, job.disturb)
        if key != self._key:
            self.close()
            arguments = {"task": job.task, **({} if job.instruction == "right" else {"instruction": job.instruction})}
            with time_limit("make()", job.task, None, job.timeout_s):
                self._environment = call_factory(job.environment, Path(job.folder), arguments)
            self._key, self._job = key, job
        return self._environment

    def play(self, job: EpisodesJob, limit: int = STEP_LIMIT, tell: OnProgress = lambda *_: None) -> list[Outcome]:
        """Play the episodes of a job; tell of each that it begins."""
        spec = self.policy.spec
        os.chdir(self._home)  # an environment before may have changed it, and the next one's file is named from here
        controller = self.controller(job)
        world = world_of(self.environment(job), job.task, spec, job.film, job.timeout_s)
        self._job = job
        with self.policy.recording(Path(job.record)) if job.record else contextlib.nullcontext():
            outcomes = []
            for seed in job.seeds:
                tell(under_way(job.task, seed), None)
                outcomes.append(_episode(world, controller, spec, job, seed, limit))
                if len(job.seeds) > 1 and not job.show:
                    tell(f"{OUTCOME_PREFIX}{json.dumps(to_json(outcomes[-1]))}", None)
            return outcomes

    def controller(self, job: EpisodesJob) -> Controller:
        """Return the controller of a job: of the policy, with noise where there is any, or one that does not look."""
        spec = self.policy.spec
        acting = build_controller(
            self.policy, job.controller, int(job.latency_ms * spec.rate / 1e3) if job.latency_ms else 0
        )
        if job.control:
            acting = Blind(job.control, spec.action, self._policy_answers())
        if job.noise:
            acting = Noisy(acting, spec.action, job.noise, self._policy_answers())
        if job.disturb in BUILT_IN_DISTURBANCES:
            acting = DisturbedController(acting, spec, job.disturb, job.strength)
        return acting

    def _policy_answers(self) -> Array:
        """Return what the policy answers to recorded observations; asked once, and before frames are recorded."""
        if self._answers is None:
            self._answers = answers_of(self.policy, observations_for(self._bundle, ANSWERED_OBSERVATIONS))
        return self._answers

    def close(self) -> None:
        """Close the open environment; one that fails to close has done its work all the same."""
        environment, self._environment, self._key = self._environment, None, ()
        if environment is not None and self._job is not None:
            _close(environment, self._job)


def _open_policy(bundle: Bundle, engine: str) -> BundlePolicy:
    """Verify and open a bundle, without its recordings; one that is not exported yet runs in torch.

    An inference that takes longer than any that a robot could use is stopped.
    """
    bundle.verify(but=RECORDINGS)
    if bundle.manifest.graphs:
        policy = BundlePolicy.open(bundle, engine=engine, threads=1, seed=0)
        policy.warm_up(1)
        policy.limit_s = FIRST_RUN_S
        return policy
    from vlatool.module.torch_policy import torch_policy

    require("torch", "build").set_num_threads(1)
    return torch_policy(bundle, 0)


_worker: Worker | None = None


def play(request: Mapping[str, Any], tell: OnProgress) -> dict[str, Any]:
    """Answer a ``Request`` in this process with ``Played``."""
    global _worker
    asked = from_json(Request, request)
    if _worker is None:
        _worker = Worker(asked.bundle, asked.engine)
    answer: dict[str, Any] = to_json(Played(tuple(_worker.play(asked.job, asked.limit, tell))))
    return answer


def open_bundle(request: Mapping[str, Any], _tell: OnProgress) -> None:
    """Open a ``Request``'s bundle here as its episodes would; raises BundleError, GraphError when it cannot be."""
    asked = from_json(Request, request)
    _open_policy(Bundle.open_lazily(asked.bundle), asked.engine)


def disturbances(request: Mapping[str, Any], _tell: OnProgress) -> list[str]:
    """Answer a ``Request`` in this process with the disturbances that the environment of its task offers."""
    asked = from_json(Request, request)
    spec = Bundle.open_lazily(asked.bundle).manifest.spec
    with time_limit("make()", asked.job.task, None, asked.job.timeout_s):
        environment = call_factory(asked.job.environment, Path(asked.job.folder), {"task": asked.job.task})
    try:
        with error_context(asked.job.task):
            return list(World(environment, asked.job.task, spec).disturbances())
    finally:
        _close(environment, asked.job)


def _close(environment: Any, job: EpisodesJob) -> None:
    """Close an environment; one that fails to close has done its work all the same, one that never ends has not."""
    last = job.seeds[-1] if job.seeds else None
    with contextlib.suppress(Exception), time_limit("close()", job.task, last, job.timeout_s, "after"):
        environment.close()


def close(_request: Mapping[str, Any], _tell: OnProgress) -> None:
    """Close what is open in this process."""
    global _worker
    if _worker is not None:
        _worker.close()
    _worker = None


def _episode(
    world: World, controller: Controller, spec: PolicySpec, job: EpisodesJob, seed: int, limit: int
) -> Outcome:
    task = job.task
    with error_context(task, seed, (job.disturb, job.strength) if job.disturb else None):
        if job.disturb and job.disturb not in BUILT_IN_DISTURBANCES:
            world.disturb(job.disturb, job.strength, seed)
        observation, info = world.reset(seed)
        controller.reset(seed)
        success, body = Success(), Body(spec)
        body.look(info)
        instruction, start = instruction_of(observation, spec), start_of(observation, spec)
        for step in range(1, limit):
            action = _action(controller, observation, f"task '{task}' at seed {seed}, step {step},")
            observation, over, info = world.step(action.item() if action.ndim == 0 else action)
            success.look(info)
            body.add_action(action, controller.fresh)
            body.look(info)
            if over:
                track = body.track()
                series = series_of(track, spec.action) if job.show else {}
                won = success.at_the_end(task, seed)
                return Outcome(task, seed, won, step, instruction, measure_episode(track), body.refused, series, start)
        raise DataError(f"The environment of task '{task}' did not end within {limit} steps at seed {seed}.",
                        "let step() return truncated=True after as many steps as an episode may take")  # fmt: skip


def instruction_of(observation: Mapping[str, Any], spec: PolicySpec) -> str:
    """Return the instruction of an observation; empty for a policy that takes no text, or several."""
    texts = [tensor.name for tensor in spec.inputs if tensor.kind == "text"]
    value = observation[texts[0]] if len(texts) == 1 and texts[0] in observation else ""
    value = value[0] if isinstance(value, list | tuple | np.ndarray) and len(value) == 1 else value
    return one_line(value, MAX_INSTRUCTION_LENGTH) if isinstance(value, str) else ""


def start_of(observation: Mapping[str, Any], spec: PolicySpec) -> str:
    """Return a hash of what the policy is given of a first observation: the same for episodes that begin alike."""
    digest = hashlib.sha256()
    for name in (tensor.name for tensor in spec.inputs if tensor.name in observation):
        value = np.asarray(observation[name])
        content = value.tobytes() if value.dtype.kind in "biuf" else repr(value.tolist()).encode()
        digest.update(f"{name} {value.shape} {value.dtype.kind} {len(content)} ".encode() + content)
    return digest.hexdigest()[:16]


def _action(controller: Controller, observation: Mapping[str, Any], where: str) -> Array:
    """Return the action; an observation that the policy does not take is the environment's."""
    try:
        return controller.act(observation)
    except DataError as error:
        raise DataError(
            f"The environment, in {where} gives what the policy does not take: {error.message}",
            f"let it give what the policy was trained on ({error.fix}); {GUIDE}",
        ) from error
