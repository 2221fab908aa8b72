"""Which weights did best, when there is no use in going on, and which observations are held out to say so."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vlatool.data import Recording
from vlatool.training.best import Best
from vlatool.training.held_out import held_out_mask


def looked(scores: list[float]) -> Best:
    best = Best()
    for step, score in enumerate(scores):
        best.look(score, step, {"w": torch.tensor(float(step))})
    return best


@pytest.mark.parametrize(("scores", "step", "unimproved"), [
    ([0.5], 0, 0),
    ([0.5, 0.6, 0.55], 1, 1),
    ([0.5, 0.6, 0.6], 2, 1),
    ([0.9, 0.6, 0.7, 0.8], 0, 3),
    ([-0.3, -0.2, -0.1], 2, 0),
])  # fmt: skip
def test_the_best_and_the_later_of_equals(scores: list[float], step: int, unimproved: int):
    best = looked(scores)
    assert (best.step, float(best.weights["w"]), best.rounds_without_improvement(len(scores))) == (
        step,
        float(step),
        unimproved,
    )
    again = Best.of(best.text(), best.weights)
    again.look(1.0, 9, {"w": torch.tensor(9.0)})
    assert again.scores == [*scores, 1.0]


def test_what_was_said_of_the_first_scores_stays():
    best = looked([0.5, 0.4, 0.3, 0.9])
    assert [best.rounds_without_improvement(number) for number in (1, 2, 3, 4)] == [0, 1, 2, 0]


def recording(size: int, episodes: list[int] | None) -> Recording:
    from pathlib import Path

    return Recording(Path("r.npz"), {"x": np.zeros((size, 1))}, None, None if episodes is None else np.array(episodes))


def test_whole_episodes_are_held_out():
    episodes = [7] * 5 + [3] * 5 + [9] * 5 + [1] * 5
    held = held_out_mask(recording(20, episodes))
    assert held.sum() == 5
    assert len({episode for episode, out in zip(episodes, held, strict=True) if out}) == 1
    many = held_out_mask(recording(400, [number // 4 for number in range(400)]))
    assert many.sum() == 40


@pytest.mark.parametrize("size", [2, 3, 9, 20, 1000])
@pytest.mark.parametrize("episodes", [None, "one"])
def test_without_episodes_stretches_are_held_out(size: int, episodes: str | None):
    held = held_out_mask(recording(size, None if episodes is None else [4] * size))
    assert 1 <= held.sum() <= max(1, size // 5)
    assert held.sum() < size
