"""Collects labelled frames from Meta-World's scripted experts: noisy demonstrations and DAgger roll-outs.

Every frame carries the chunk of clean expert actions from exactly that state: the simulation is saved, the expert
runs eight steps ahead without noise, and the state is restored. What is executed may differ from the label (noise,
a random start phase, or the policy's own actions), so the labels also show how to recover.
"""

import warnings
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import environment as tasks
import numpy as np

CHUNK = 8
EXECUTE = 4
NOISE_LEVELS = (0.0, 0.25, 0.5)
NOISE_HOLD = 4
MAX_START_STEPS = 25
UNITS = np.array([tasks.METRES_PER_UNIT] * 3 + [1.0], np.float32)


@dataclass
class Frames:
    """Labelled frames: image (N, 96, 96, 3), proprio (N, 4), action (N, 8, 4) physical, task and episode (N,)."""

    image: np.ndarray
    proprio: np.ndarray
    action: np.ndarray
    task: np.ndarray
    episode: np.ndarray

    def __len__(self) -> int:
        return len(self.image)

    def select(self, index: np.ndarray) -> "Frames":
        """The frames at `index`."""
        return Frames(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @staticmethod
    def join(parts: "list[Frames]") -> "Frames":
        """Concatenates several sets of frames."""
        return Frames(*(np.concatenate([getattr(p, name) for p in parts]) for name in Frames.__dataclass_fields__))


@dataclass(frozen=True)
class Job:
    """Episodes of one task for one worker; with `policy_folder` the policy there acts (DAgger), else the expert."""

    task: str
    seeds: tuple[int, ...]
    policy_folder: Path | None = None


class Expert:
    """Meta-World's scripted policy of a task, which reads the simulation state."""

    def __init__(self, task: str) -> None:
        from metaworld import policies

        name = "".join(part.capitalize() for part in task.split("-"))
        self._policy = getattr(policies, f"Sawyer{name}V3Policy")()

    def act(self, simulation: Any) -> np.ndarray:
        """Clean action in Meta-World units, clipped to [-1, 1]."""
        state = np.hstack([simulation._get_curr_obs_combined_no_goal(), np.zeros(21)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the scripts warn that their gains saturate
            return np.clip(self._policy.get_action(state), -1.0, 1.0)

    def chunk(self, simulation: Any) -> np.ndarray:
        """The next eight clean actions from the current state, physical units, (8, 4); the state is kept."""
        import mujoco

        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        saved = np.empty(mujoco.mj_stateSize(simulation.model, kind))
        mujoco.mj_getState(simulation.model, simulation.data, saved, kind)
        length = simulation.curr_path_length
        actions = []
        for _ in range(CHUNK):
            actions.append(self.act(simulation))
            simulation.step(actions[-1])
        mujoco.mj_setState(simulation.model, simulation.data, saved, kind)
        mujoco.mj_forward(simulation.model, simulation.data)
        simulation.curr_path_length = length
        return np.array(actions, np.float32) * UNITS


class NoisyExpert:
    """Executes the expert with held Gaussian noise after a random start phase."""

    def __init__(self, expert: Expert, generator: np.random.Generator) -> None:
        self._expert, self._generator = expert, generator
        self._level = generator.choice(NOISE_LEVELS)
        self._start_steps = generator.integers(MAX_START_STEPS) if generator.random() < 0.6 else 0
        self._start_action = np.append(generator.uniform(-1, 1, 3), generator.choice([-1.0, 0.0, 1.0]))
        self._noise = np.zeros(4)
        self._step = 0

    def __call__(self, simulation: Any) -> np.ndarray:
        """Next executed action in physical units."""
        if self._step % NOISE_HOLD == 0:
            self._noise[:3] = self._generator.normal(0.0, self._level, 3) if self._level else 0.0
        self._step += 1
        if self._step <= self._start_steps:
            return self._start_action * UNITS
        return np.clip(self._expert.act(simulation) + self._noise, -1.0, 1.0) * UNITS


def expert_episode(env: tasks.MetaWorldEnv, expert: Expert, seed: int) -> tuple[list[dict[str, Any]], bool]:
    """One noisy demonstration; a frame every two to four steps. Returns the frames and the success."""
    generator = np.random.default_rng([seed, 3])
    observation, _ = env.reset(seed=seed)
    execute = NoisyExpert(expert, generator)
    frames = []
    while True:
        frames.append(_frame(env, expert, observation, seed))
        for _ in range(generator.integers(2, EXECUTE + 1)):
            observation, _, terminated, truncated, info = env.step(execute(env.simulation))
            if terminated or truncated:
                return frames, info["success"]


def policy_episode(env: tasks.MetaWorldEnv, expert: Expert, runner: Callable, seed: int) -> list[dict[str, Any]]:
    """One DAgger episode: the policy acts, the expert labels."""
    observation, _ = env.reset(seed=seed)
    frames = []
    while True:
        frames.append(_frame(env, expert, observation, seed))
        for action in runner(observation)[:EXECUTE]:
            observation, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                return frames


def _frame(env: tasks.MetaWorldEnv, expert: Expert, observation: Any, seed: int) -> dict[str, Any]:
    return {
        "image": observation["image"],
        "proprio": observation["proprio"],
        "action": expert.chunk(env.simulation),
        "task": tasks.TASKS.index(env.task),
        "episode": seed,
    }


def run_job(job: Job) -> Frames:
    """Collects the episodes of a job; demonstrations that fail are dropped, DAgger episodes are all kept."""
    env, expert = tasks.make(job.task), Expert(job.task)
    frames: list[dict[str, Any]] = []
    if job.policy_folder is None:
        for seed in job.seeds:
            episode, success = expert_episode(env, expert, seed)
            frames += episode if success else []
    else:
        runner = _load_runner(job.policy_folder)
        for seed in job.seeds:
            frames += policy_episode(env, expert, runner, seed)
    env.close()
    return Frames(*(np.array([frame[name] for frame in frames]) for name in Frames.__dataclass_fields__))


def _load_runner(folder: Path) -> Callable:
    import torch
    from acting import load_runner

    torch.set_num_threads(1)
    return load_runner(folder)


def collect(
    first_seed: int, episodes: int, workers: int, advance: Callable[[], Any], policy_folder: Path | None = None
) -> Frames:
    """Collects `episodes` per task in worker processes; deterministic in the seeds. `advance` ticks per job."""
    step = 10
    jobs = [
        Job(task, tuple(range(start, min(start + step, first_seed + episodes))), policy_folder)
        for task in tasks.TASKS
        for start in range(first_seed, first_seed + episodes, step)
    ]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures: list[Future[Frames]] = [pool.submit(run_job, job) for job in jobs]
        for _ in as_completed(futures):
            advance()
    return Frames.join([future.result() for future in futures])
