"""A faster control loop than the policy's: what lies between two of its actions, by mode."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from _numbered import MOVES, EchoController, NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import UsageError
from vlatool.runtime.control import build_controller
from vlatool.runtime.control.interpolation import InterpolatingController


def played(mode: str, factor: int, method: str, targets: list[list[float]]) -> np.ndarray[Any, Any]:
    """Return the actions (factor x targets, A) for actions (A,) of the policy, one after the other."""
    echo = EchoController("target")
    spec = spec_of(action=replace(MOVES, mode=mode))
    controller = InterpolatingController(echo, spec=spec, factor=factor, method=method)
    steps = [np.array(target, np.float32) for target in targets for _ in range(factor)]
    actions = np.stack([controller.act({"target": each}) for each in steps])
    assert len(echo.observations) == len(targets)
    return actions


@pytest.mark.parametrize("mode", ["absolute", "velocity"])
def test_targets_are_reached_at_the_last_step(mode: str):
    actions = played(mode, 4, "linear", [[1, -1], [3, 1], [3, 1]])
    assert actions[:, 0].tolist() == [1, 1, 1, 1, 1.5, 2, 2.5, 3, 3, 3, 3, 3]
    assert actions[:, 1].tolist() == [-1] * 4 + [1] * 8, "the gripper gets each command at once"


@pytest.mark.parametrize("method", ["linear", "minimum_jerk"])
@pytest.mark.parametrize("factor", [2, 5, 25])
def test_differences_are_divided(method: str, factor: int):
    actions = played("delta", factor, method, [[1, -1], [-0.3, 1]])
    sums = actions[:, 0].reshape(2, factor).sum(axis=1)
    np.testing.assert_allclose(sums, [1, -0.3], rtol=1e-5)
    assert (actions[:factor, 1] == -1).all()


def test_least_jerk_begins_and_ends_at_rest():
    positions = played("absolute", 50, "minimum_jerk", [[0, 0], [1, 0]])[50:, 0]
    time = np.arange(1, 51) / 50
    np.testing.assert_allclose(positions, 10 * time**3 - 15 * time**4 + 6 * time**5, atol=1e-6)
    assert abs(positions[-1] - positions[-2]) < 1e-4


def test_rotations_turn_along_the_shortest_arc():
    step = {"op": "rotation", "parts": [[0, 4]], "robot": "quaternion_xyzw", "network": "6d_columns"}
    action = TensorSpec.from_dict({"name": "a", "shape": [1, 1, 6], "mode": "absolute", "convert": [step]})
    controller = InterpolatingController(EchoController("q"), spec=spec_of(action=action), factor=2)
    ends = [np.array([0, 0, 0, 1.0]), np.array([0, 0, -np.sin(0.3), -np.cos(0.3)])]
    actions = [controller.act({"q": end.astype(np.float32)}) for end in ends for _ in range(2)]
    half = actions[2] * np.sign(actions[2][3])
    np.testing.assert_allclose(half, [0, 0, np.sin(0.15), np.cos(0.15)], atol=1e-6)


def test_only_the_first_step_of_a_chunk_is_fresh_and_a_reset_starts_over():
    policy = NumberedPolicy(spec_of(2))
    controller = build_controller(policy, ["interpolation:factor=3"])
    fresh = []
    for t in range(12):
        controller.act({"t": t})
        fresh.append(controller.fresh)
    assert [t for t, is_fresh in enumerate(fresh) if is_fresh] == [0, 6]
    assert policy.asked == [0, 6]
    controller.act({"t": 12})
    controller.reset(4)
    controller.act({"t": 20})
    assert (policy.asked[-1], policy.seeds) == (20, [4])


def test_a_failed_step_is_asked_again():
    class Failing(EchoController):
        def act(self, observation: Any) -> Any:
            if observation["target"] is None:
                raise RuntimeError
            return super().act(observation)

    controller = InterpolatingController(Failing("target"), spec=spec_of(), factor=2)
    with pytest.raises(RuntimeError):
        controller.act({"target": None})
    np.testing.assert_allclose(controller.act({"target": np.ones(2, np.float32)}), [0.5, 1])


@pytest.mark.parametrize(
    ("arguments", "action", "message"),
    [({"factor": 0}, MOVES, "factor is 0; allowed"), ({"method": "cubic"}, MOVES, "no method 'cubic'"),
     ({"factor": 2}, replace(MOVES, mode=""), "of the mode ''"),
     ({"factor": 2}, replace(MOVES, mode="relative"), "mode"),
     ({"factor": 2}, TensorSpec("a", (1, 3), kind="discrete", labels=("l", "r", "f")), "'a' is discrete")],
)  # fmt: skip
def test_what_cannot_be_interpolated_is_refused(arguments: dict[str, Any], action: TensorSpec, message: str):
    with pytest.raises(UsageError, match=message):
        InterpolatingController(EchoController("x"), spec=spec_of(action=action), **arguments)
