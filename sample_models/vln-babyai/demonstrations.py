"""Expert-labelled GoToLocal episodes, stored as tile codes, and batches of them under the task's symmetries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from environment import BLANK, COLOURS, FIRST_OBJECT, FRAMES, NO_ACTION, TYPES, UNSEEN, VIEW
from numpy.typing import NDArray
from rollout import ARTICLES, LADDER, SENTENCES, Chooser, Episode, play

MIRRORED_ACTIONS = np.array([1, 0, 2, NO_ACTION])
LAST_MOVE = 2  # minigrid actions above forward are not needed; the bot's "done" may be any blocked move


@dataclass
class Batch:
    """Samples of the policy's inputs and the expert's answer.

    Attributes:
        codes: (B, T, 7, 7) uint8 tile codes.
        actions: (B, T - 1) int64 previous actions.
        instruction: (B, 8) int64 word ids.
        expert: (B,) int64 the bot's action.
    """

    codes: NDArray[np.uint8]
    actions: NDArray[np.int64]
    instruction: NDArray[np.int64]
    expert: NDArray[np.int64]


@dataclass
class Demonstrations:
    """Growing store of steps; consecutive rows of one episode are consecutive in time.

    Columns per step: tile codes (7, 7), action taken, expert action, step in the episode, (article, colour, type),
    index of the task in LADDER, seed.
    """

    codes: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, VIEW, VIEW), np.uint8))
    facts: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 8), np.int64))

    def __len__(self) -> int:
        return len(self.facts)

    def extend(self, other: Demonstrations) -> None:
        """Append the steps of `other`."""
        self.codes = np.concatenate((self.codes, other.codes))
        self.facts = np.concatenate((self.facts, other.facts))

    def batch(self, rows: NDArray[np.int64]) -> Batch:
        """The samples whose current step is at `rows`, with their histories."""
        ages = np.arange(FRAMES - 1, -1, -1)
        history = np.maximum(rows[:, None] - ages, 0)
        known = self.facts[rows, 2][:, None] >= ages
        codes = np.where(known[..., None, None], self.codes[history], np.uint8(BLANK))
        actions = np.where(known, self.facts[history, 0], NO_ACTION)[:, :-1]
        article, colour, kind = self.facts[rows, 3:6].T
        return Batch(codes, actions, SENTENCES[article, colour, kind], self.facts[rows, 1])

    def augmented_batch(self, size: int, rng: np.random.Generator) -> Batch:
        """Random samples, each under a random colour permutation, type permutation and left-right mirror."""
        rows = rng.integers(len(self), size=size)
        plain = self.batch(rows)
        colours, kinds, mirror = draw_symmetries(size, rng)
        table = symmetric_codes(colours, kinds)
        codes = np.take_along_axis(table, plain.codes.reshape(size, -1), axis=1).reshape(plain.codes.shape)
        article, colour, kind = self.facts[rows, 3:6].T
        index = np.arange(size)
        return Batch(
            np.where(mirror[:, None, None, None], codes[..., ::-1], codes),
            np.where(mirror[:, None], MIRRORED_ACTIONS[plain.actions], plain.actions),
            SENTENCES[article, colours[index, colour], kinds[index, kind]],
            np.where(mirror, MIRRORED_ACTIONS[plain.expert], plain.expert),
        )


def draw_symmetries(
    size: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Per sample a permutation of the colours (B, 6), one of the types (B, 3) and whether to mirror (B,)."""
    colours = rng.random((size, len(COLOURS))).argsort(axis=1)
    kinds = rng.random((size, len(TYPES))).argsort(axis=1)
    return colours, kinds, rng.random(size) < 0.5


def symmetric_codes(colours: NDArray[np.int64], kinds: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Per sample the new code of every tile code, (B, CODES)."""
    size = len(colours)
    objects = FIRST_OBJECT + kinds[:, :, None] * len(COLOURS) + colours[:, None, :]
    unchanged = np.broadcast_to(np.arange(FIRST_OBJECT), (size, FIRST_OBJECT))
    return np.concatenate((unchanged, objects.reshape(size, -1)), axis=1).astype(np.uint8)


class Recorder:
    """Asks BabyAIBot for its action in every state that an episode visits, and records both actions."""

    def __init__(self) -> None:
        self._bots: dict[int, Any] = {}
        self._steps: dict[int, list[tuple[NDArray[np.uint8], list[int]]]] = {}

    def expert_action(self, episode: Episode) -> int:
        """The bot's action in the current state; it may be asked once per state."""
        from minigrid.utils.baby_ai_bot import BabyAIBot

        env = episode.env
        if episode.seed not in self._bots:
            # The bot only reads which tiles are visible, so minigrid need not build its own view.
            env.level.gen_obs_grid = lambda: (None, (env.view_codes[-1] != UNSEEN).T)
            self._bots[episode.seed] = BabyAIBot(env.level)
            self._steps[episode.seed] = []
        previous = None if episode.length == 0 else int(env.past_actions[-1])
        return min(int(self._bots[episode.seed].replan(previous)), LAST_MOVE)

    def record(self, episode: Episode, action: int, expert: int) -> None:
        """Store the current state with the action about to be taken and the expert's."""
        words = episode.env.instruction.split()
        goal = [ARTICLES.index(words[2]), COLOURS.index(words[3]), TYPES.index(words[4])]
        facts = [action, expert, episode.length, *goal, list(LADDER).index(episode.task), episode.seed]
        self._steps[episode.seed].append((episode.env.view_codes[-1], facts))

    def demonstrations(self) -> Demonstrations:
        """All recorded steps, episode by episode."""
        steps = [step for episode in self._steps.values() for step in episode]
        return Demonstrations(np.stack([codes for codes, _ in steps]), np.array([facts for _, facts in steps]))


def collect(
    starts: Sequence[tuple[str, int]], rng: np.random.Generator, policy: Chooser | None, noise: float
) -> Demonstrations:
    """Play `starts` with the policy (the expert if None), each action random with probability `noise`."""
    recorder = Recorder()
    expert: dict[int, int] = {}

    def choose(episodes: Sequence[Episode]) -> NDArray[np.int64]:
        expert.update({episode.seed: recorder.expert_action(episode) for episode in episodes})
        wanted = policy(episodes) if policy else np.array([expert[episode.seed] for episode in episodes])
        random = rng.random(len(episodes)) < noise
        return np.where(random, rng.integers(3, size=len(episodes)), wanted)

    play(choose, starts, before_step=lambda episode, action: recorder.record(episode, action, expert[episode.seed]))
    return recorder.demonstrations()
