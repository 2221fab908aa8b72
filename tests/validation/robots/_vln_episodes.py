"""Episodes of the sample policy vln-babyai: in its discrete environment, and in continuous motion in one process."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _loop import Loop

from vlatool.controllers.vln import Vln
from vlatool.episodes.play import EVALUATION_SEEDS
from vlatool.stats.intervals import wilson
from vlatool.worlds import open_world

ROOT = Path(__file__).resolve().parents[3]
SAMPLE = ROOT / "sample_models/vln-babyai"
FIRST_SEED = EVALUATION_SEEDS
"""That of ``vlatool evaluate closed-loop``."""
RESTING = 0.01
"""Speed below which a base stands, in m/s and rad/s."""
REST_S = 1.0
"""How long after the end of a task it is looked whether the base stands."""
LIMIT_S = 900.0
"""Simulated time after which an episode ends in any case."""
ENDED = ("arrived", "failed")
"""First word of the status once the controller has ended a task by itself."""


@dataclass(frozen=True)
class EpisodeEnd:
    """How an episode ended.

    Args:
        seed: Seed of the level and of the noise.
        success: Whether the base stood where MiniGrid says that the mission is done, a second after the task's end.
        stopped: Whether the controller ended the task by itself, and the base stood a second later.
        actions: Labels of the actions of the policy.
        collisions: How often the base was held up by a wall or an object.
        seconds: Simulated time.
    """

    seed: int
    success: bool
    stopped: bool
    actions: tuple[str, ...]
    collisions: int = 0
    seconds: float = 0.0


def stands(truth: Any) -> bool:
    """Whether a base stands, by what its world says."""
    return max(map(abs, truth["velocity"])) < RESTING


def discrete_episode(task: str, seed: int, policy: Any) -> EpisodeEnd:
    """Play an episode in the environment of the sample, as ``vlatool evaluate closed-loop`` does."""
    sys.path[:0] = [str(SAMPLE)] if str(SAMPLE) not in sys.path else []
    import environment

    level = environment.make(task)
    observation, _ = level.reset(seed=seed)
    policy.reset()
    over, actions, success = False, [], False
    while not over:
        actions.append(int(np.asarray(policy.infer(observation).chunk).reshape(-1)[0]))
        observation, _, ended, truncated, info = level.step(actions[-1])
        over, success = ended or truncated, bool(info["success"])
    return EpisodeEnd(seed, success, True, labels_of(policy, actions))


def continuous_episode(task: str, seed: int, policy: Any) -> EpisodeEnd:
    """Play an episode in continuous motion, world and controller in step in this process."""
    world: Any = open_world("babyai", task=task)
    world.reset(seed)
    loop = Loop(world, [Vln(policy=policy, max_actions=world.max_actions)])
    while loop.nodes[0].state.phase not in ENDED and world.time_s < LIMIT_S:
        loop.run(0.5)
    seconds = world.time_s
    loop.run(REST_S)
    truth, state = world.truth(), loop.nodes[0].state
    stopped = state.phase in ENDED and stands(truth)
    actions = labels_of(policy, state.actions)
    return EpisodeEnd(seed, truth["arrived"], stopped, actions, truth["collisions"], seconds)


def paired_episodes(task: str, seeds: Iterable[int], policy: Any, file: Path | None) -> list[tuple[EpisodeEnd, ...]]:
    """Return the discrete and the continuous episode of each seed; those that are in the file are not played again."""
    known = {}
    for line in file.read_text().splitlines() if file is not None and file.exists() else ():
        row = json.loads(line)
        known[row["task"], row["ends"][0]["seed"]] = tuple(end_of(values) for values in row["ends"])
    for seed in seeds:
        if (task, seed) in known:
            continue
        ends = (discrete_episode(task, seed, policy), continuous_episode(task, seed, policy))
        known[task, seed] = ends
        if file is not None:
            with file.open("a") as lines:
                lines.write(json.dumps({"task": task, "ends": [asdict(end) for end in ends]}) + "\n")
    return [known[task, seed] for seed in seeds]


def end_of(values: dict[str, Any]) -> EpisodeEnd:
    """Return the end of an episode from its JSON."""
    return EpisodeEnd(**{**values, "actions": tuple(values["actions"])})


def labels_of(policy: Any, actions: Any) -> tuple[str, ...]:
    """Return the labels of actions of a policy."""
    return tuple(policy.spec.action.labels[index] for index in actions)


def rate_of(ends: list[EpisodeEnd]) -> str:
    """Return the share of successes with its interval, as text."""
    successes = sum(end.success for end in ends)
    low, high = wilson(successes, len(ends))
    return f"{successes} of {len(ends)} ({100 * successes / len(ends):.1f} %, {100 * low:.1f} to {100 * high:.1f})"
