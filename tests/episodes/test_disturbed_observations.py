"""Observations that come late, or are lost: the same for every policy, and nothing at strength 0."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from _numbered import EchoController

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.episodes.disturbances import DisturbedController


def spec(hz: float) -> PolicySpec:
    return PolicySpec((TensorSpec("state", (1, 1)),), (TensorSpec("action", (1, 1)),), control_hz=hz, chunk=1)


def seen(kind: str, strength: float, seed: int = 3, hz: float = 20.0, steps: int = 200) -> list[int]:
    acting = DisturbedController(EchoController("state"), spec(hz), kind, strength)
    acting.reset(seed)
    state = np.zeros(1)
    times = []
    for step in range(steps):
        state[0] = step  # an environment may use its arrays again
        times.append(int(acting.act({"state": state, "further": object()})[0]))
    return times


@pytest.mark.parametrize(("hz", "strength", "late"), [(20, 1, 1), (80, 1, 4), (80, 0.5, 2), (5, 1, 1), (100, 4, 20)])
def test_a_delay_is_of_whole_steps(hz: float, strength: float, late: int):
    assert seen("delay", strength, hz=hz) == [max(0, step - late) for step in range(200)]


def test_dropped_frames_show_the_last_one_again():
    times = seen("dropped_frames", 3.0)
    lost = sum(time != step for step, time in enumerate(times))
    assert 40 <= lost <= 80, "30 % of 200"
    assert all(later >= time for time, later in itertools.pairwise(times))
    assert times == seen("dropped_frames", 3.0)
    assert times != seen("dropped_frames", 3.0, seed=4)
    assert times[0] == 0


@pytest.mark.parametrize("kind", ["delay", "dropped_frames", "light", ""])
def test_nothing_is_changed_at_strength_0_and_by_other_disturbances(kind: str):
    inner = EchoController("state")
    acting = DisturbedController(inner, spec(20.0), kind, 0.0 if kind in ("delay", "dropped_frames") else 2.0)
    observation = {"state": np.ones(1)}
    acting.act(observation)
    assert inner.observations[0] is observation
