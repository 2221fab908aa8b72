"""What calibrates is not what evaluates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vlatool.data import Recording, halves


def recording(count: int, episodes: list[int] | None = None) -> Recording:
    """Observations that are their own numbers."""
    numbers = np.arange(count, dtype=np.float32).reshape(-1, 1)
    own = None if episodes is None else np.array(episodes, np.int64)
    return Recording(Path("r.npz"), {"x": numbers}, numbers[:, :, None], own)


def numbers(found: Recording) -> list[int]:
    return [int(value) for value in found.inputs["x"][:, 0]]


@pytest.mark.parametrize("count", [16, 17, 100, 1001])
def test_stretches_take_turns_and_nothing_is_lost(count: int) -> None:
    one, two = halves(recording(count))
    assert sorted(numbers(one) + numbers(two)) == list(range(count))
    assert abs(len(one) - len(two)) <= 4
    ends = sum(right - left > 1 for left, right in zip(numbers(one), numbers(one)[1:], strict=False))
    assert ends == 3, "four stretches"


def test_whole_episodes_stay_together() -> None:
    episodes = [7] * 10 + [3] * 5 + [5] * 6 + [1] * 4
    one, two = halves(recording(25, episodes))
    assert one.episodes is not None
    assert {7, 1} == set(one.episodes.tolist())
    assert two.episodes is not None
    assert {3, 5} == set(two.episodes.tolist())
    assert two.actions is not None
    assert two.actions[:, 0, 0].tolist() == numbers(two)


def test_one_long_episode_is_cut_into_stretches() -> None:
    one, two = halves(recording(40, [0] * 38 + [1] * 2))
    assert (len(one), len(two)) == (20, 20)


def test_a_few_observations_are_both_halves() -> None:
    few = recording(15)
    assert halves(few) == (few, few)
