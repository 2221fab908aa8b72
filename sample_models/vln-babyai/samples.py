"""Draw the small sample files that accompany the policy: calibration.npz and evaluation.npz."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from demonstrations import Demonstrations, collect
from environment import COLOURS, TYPES, render
from numpy.typing import NDArray
from rollout import ARTICLES, LADDER, Chooser

CALIBRATION_SAMPLES = 256
EVALUATION_SAMPLES = 400
EVALUATION_SEED = 2_000_000  # above every seed of training, validation and the success table
EPISODES_PER_TASK = 40


def write_samples(policy: Chooser, out: Path) -> None:
    """Write calibration.npz from training seeds and evaluation.npz from held-out seeds."""
    calibration = draw_samples(policy, CALIBRATION_SAMPLES, first_seed=0)
    del calibration["episode"]
    np.savez_compressed(out / "calibration.npz", **calibration)
    np.savez_compressed(out / "evaluation.npz", **draw_samples(policy, EVALUATION_SAMPLES, EVALUATION_SEED))


def draw_samples(policy: Chooser, count: int, first_seed: int) -> dict[str, NDArray[Any]]:
    """States the policy visits, spread evenly over the ladder and over early and late steps, with expert actions."""
    names = [name for name in LADDER for _ in range(EPISODES_PER_TASK)]
    starts = [(name, first_seed + index) for index, name in enumerate(names)]
    visited = collect(starts, np.random.default_rng(first_seed), policy, noise=0.1)
    return as_inputs(visited, spread_rows(visited, count))


def spread_rows(visited: Demonstrations, count: int) -> NDArray[np.int64]:
    """Rows of `visited`, an equal number per task and, within a task, evenly from its first to its last steps."""
    shares = np.diff(np.linspace(0, count, len(LADDER) + 1).astype(int))
    chosen = []
    for task, share in enumerate(shares):
        rows = np.flatnonzero(visited.facts[:, 6] == task)
        rows = rows[np.argsort(visited.facts[rows, 2], kind="stable")]
        chosen.append(rows[np.linspace(0, len(rows) - 1, share).astype(int)])
    return np.concatenate(chosen)


def as_inputs(visited: Demonstrations, rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """The policy's raw inputs at `rows`, the expert's action and the seed of the episode."""
    batch = visited.batch(rows)
    goals = visited.facts[rows, 3:6]
    instruction = [f"go to {ARTICLES[article]} {COLOURS[colour]} {TYPES[kind]}" for article, colour, kind in goals]
    return {
        "image": render(batch.codes),
        "actions": batch.actions,
        "instruction": np.array(instruction),
        "action": batch.expert,
        "episode": visited.facts[rows, 7],
    }
