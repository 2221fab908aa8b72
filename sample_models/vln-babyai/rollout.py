"""Play many GoToLocal episodes in lock-step, so that one batched call chooses all actions."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from environment import ACTIONS, COLOURS, TYPES, GoToLocal
from numpy.typing import NDArray
from policy import MAX_TOKENS

LADDER = {  # task: share of the training episodes
    "GoToLocalS5N2": 0.08,
    "GoToLocalS6N2": 0.05,
    "GoToLocalS6N3": 0.15,
    "GoToLocalS6N4": 0.10,
    "GoToLocalS7N4": 0.10,
    "GoToLocalS8N4": 0.22,
    "GoToLocal": 0.30,
}
ARTICLES = ("the", "a")
RANDOM_STREAM = 20_021
WORD_IDS: dict[str, int] = json.loads(Path(__file__).with_name("vocabulary.json").read_text())["words"]


@dataclass
class Episode:
    """One running or finished episode."""

    env: GoToLocal
    task: str
    seed: int
    success: bool = False
    done: bool = False
    length: int = 0


Chooser = Callable[[Sequence[Episode]], NDArray[np.int64]]
Watcher = Callable[[Episode, int], None]


def word_ids(instruction: str) -> list[int]:
    """Token ids of an instruction, padded with 0 to MAX_TOKENS; an unknown word is 1."""
    ids = [WORD_IDS.get(word, 1) for word in instruction.lower().split()][:MAX_TOKENS]
    return ids + [0] * (MAX_TOKENS - len(ids))


# All 36 instructions as token ids, (article, colour, type, MAX_TOKENS).
SENTENCES = np.array([[[word_ids(f"go to {a} {c} {k}") for k in TYPES] for c in COLOURS] for a in ARTICLES])


def start(task: str, seed: int, instruction: str = "right") -> Episode:
    """Reset a new environment of `task` to `seed`."""
    env = GoToLocal(task, instruction)
    env.reset(seed=seed)
    return Episode(env, task, seed)


def play(
    choose: Chooser,
    starts: Sequence[tuple[str, int]],
    instruction: str = "right",
    before_step: Watcher | None = None,
    width: int = 64,
) -> list[Episode]:
    """Play the (task, seed) pairs to their ends, `width` at a time; `before_step` sees each chosen action."""
    finished: list[Episode] = []
    for first in range(0, len(starts), width):
        active = [start(task, seed, instruction) for task, seed in starts[first : first + width]]
        finished += active
        while active:
            for episode, action in zip(active, choose(active), strict=True):
                if before_step:
                    before_step(episode, int(action))
                episode.length += 1
                time_is_up, episode.success = episode.env.move(int(action))
                episode.done = time_is_up or episode.success
            active = [episode for episode in active if not episode.done]
    return finished


def random_mover(episodes: Sequence[Episode]) -> NDArray[np.int64]:
    """Chance floor: left, right or forward with equal probability, drawn from the episode's seed and step."""
    return np.array([np.random.default_rng((RANDOM_STREAM, e.seed, e.length)).integers(len(ACTIONS)) for e in episodes])
