"""Temporal ensembling: weights of the chunks so far, what is refused, and the rotation of two chunks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import UsageError
from vlatool.runtime.control import build_controller
from vlatool.runtime.control.temporal_ensemble import TemporalEnsemble
from vlatool.runtime.interface import Action


def expected(step: int, chunk: int, coefficient: float) -> float:
    """Return the mean of all chunks that have a control step, offline as in ACT: chunk t says 100 t + step - t."""
    asked = np.arange(max(0, step - chunk + 1), step + 1)
    weights = np.exp(-coefficient * np.arange(len(asked)))
    return float((weights * (100 * asked + step - asked)).sum() / weights.sum())


@pytest.mark.parametrize("chunk", [1, 2, 5])
@pytest.mark.parametrize("coefficient", [0.01, 0.0, -0.3, 2.0])
def test_the_oldest_chunk_has_the_weight_one(chunk: int, coefficient: float):
    ensemble = TemporalEnsemble(NumberedPolicy(spec_of(chunk)), coefficient=coefficient)
    for step in range(12):
        action = ensemble.act({"t": step})
        np.testing.assert_allclose(action, [expected(step, chunk, coefficient) + each for each in (0, 0.5)], rtol=1e-6)
        assert ensemble.fresh


def test_an_episode_begins_anew_and_each_step_infers():
    policy = NumberedPolicy(spec_of(4, 2))
    ensemble = TemporalEnsemble(policy)
    for step in (0, 1, 2):
        ensemble.act({"t": step})
    assert policy.asked == [0, 1, 2]
    ensemble.reset(3)
    assert float(ensemble.act({"t": 7})[0]) == 700


def test_the_coefficient_is_an_option_of_the_name():
    ensemble = build_controller(NumberedPolicy(spec_of(5)), ["temporal-ensemble:coefficient=2"])
    assert [float(ensemble.act({"t": step})[0]) for step in (0, 1)] == pytest.approx([0, expected(1, 5, 2.0)])


@pytest.mark.parametrize("coefficient", [float("nan"), float("inf"), -21.0, True])
def test_weights_beyond_float32_are_refused(coefficient: Any):
    with pytest.raises(UsageError, match="coefficient is"):
        TemporalEnsemble(NumberedPolicy(spec_of(5)), coefficient=coefficient)


@pytest.mark.parametrize(
    "action",
    [TensorSpec("a", (1, 4, 3), kind="discrete", labels=("l", "r", "f")), replace(MOVES, mode="relative")],
)
def test_what_has_no_mean_is_refused(action: TensorSpec):
    with pytest.raises(UsageError, match="cannot be averaged"):
        TemporalEnsemble(NumberedPolicy(spec_of(4, action=action)))


class Turning(NumberedPolicy):
    """Infers quaternions about z, of the other sign every second time."""

    def infer(self, observation: Any, *, noise: Any = None) -> Action:
        step = int(observation["t"])
        angles = np.full(3, 0.2 * step)
        turns = np.stack([0 * angles, 0 * angles, np.sin(angles / 2), np.cos(angles / 2)], axis=1) * (-1) ** step
        return Action(turns.astype(np.float32), (), 0.0, step, {})


def test_rotations_are_averaged_as_rotations():
    step = {"op": "rotation", "parts": [[0, 4]], "robot": "quaternion_xyzw", "network": "axis_angle"}
    action = TensorSpec.from_dict({"name": "a", "shape": [1, 3, 3], "mode": "absolute", "convert": [step]})
    ensemble = TemporalEnsemble(Turning(spec_of(3, action=action)), coefficient=0.0)
    actions = [ensemble.act({"t": t}) for t in (0, 1)]
    np.testing.assert_allclose(actions[1], [0, 0, np.sin(0.05), np.cos(0.05)], atol=1e-6)
