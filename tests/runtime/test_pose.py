"""Poses that are relative to a state, against 4 x 4 matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vlatool.bundle.conversion import ROTATIONS
from vlatool.bundle.spec import PolicySpec
from vlatool.runtime.converter import action_converter
from vlatool.runtime.pose import absolute_poses, relative_poses
from vlatool.runtime.rotation import convert_rotation

RANDOM = np.random.default_rng(0)
FORMS = ("axis_angle", "quaternion_wxyz", "6d_rows", "matrix", "euler_ZYX")


def transforms(count: int) -> Any:
    """Return random 4 x 4 transforms."""
    made = np.tile(np.eye(4), (count, 1, 1))
    made[:, :3, :3] = Rotation.random(count, rng=RANDOM).as_matrix()
    made[:, :3, 3] = RANDOM.normal(size=(count, 3))
    return made


def values(made: Any, form: str) -> Any:
    rotations = convert_rotation(made[..., :3, :3].reshape(*made.shape[:-2], 9), "matrix", form)
    return np.concatenate([made[..., :3, 3], rotations], axis=-1)


@pytest.mark.parametrize("successive", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_differences_in_the_frame_of_the_tool_are_products_of_matrices(form: str, successive: bool) -> None:
    state, differences = transforms(1)[0], transforms(8)
    goals, reached = [], state
    for difference in differences:
        goals.append((reached if successive else state) @ difference)
        reached = goals[-1]
    wanted = values(np.stack(goals), form)
    given = values(differences, form), values(state, form), form, "tool"
    np.testing.assert_allclose(absolute_poses(*given, successive=successive), wanted, atol=1e-12)
    found = relative_poses(wanted, *given[1:], successive=successive)
    np.testing.assert_allclose(found, given[0], atol=1e-11)


@pytest.mark.parametrize("form", FORMS)
def test_differences_in_the_frame_of_the_base_turn_the_state_and_are_added_to_its_position(form: str) -> None:
    state, differences = transforms(1)[0], transforms(8)
    goals = differences.copy()
    goals[:, :3, :3] = differences[:, :3, :3] @ state[:3, :3]
    goals[:, :3, 3] += state[:3, 3]
    for successive in (False, True):
        given = values(differences, form), values(state, form), form, "base"
        found = absolute_poses(*given, successive=successive)
        np.testing.assert_allclose(found[0], values(goals[:1], form)[0], atol=1e-12)
        np.testing.assert_allclose(relative_poses(found, *given[1:], successive=successive), given[0], atol=1e-11)
    np.testing.assert_allclose(absolute_poses(*given, successive=False), values(goals, form), atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_a_rotation_without_a_position(form: str) -> None:
    state, differences = transforms(1), transforms(3)
    given = values(differences, form)[:, 3:], values(state, form)[0, 3:], form, "tool"
    wanted = values(state @ differences, form)[:, 3:]
    np.testing.assert_allclose(absolute_poses(*given, successive=False), wanted, atol=1e-12)


def test_a_pose_of_a_policy_that_is_relative_to_another_place_of_the_state() -> None:
    """GR00T's end effector: position and two rows in the frame of the state; the gripper stays as it is."""
    width = 3 + ROTATIONS["6d_rows"]
    step = {"op": "relative", "to": "s", "parts": ["hand"], "state": [[1, 1 + width]], "pose": "6d_rows"}
    data: dict[str, Any] = {
        "inputs": [{"name": "s", "shape": [1, width + 1]}],
        "outputs": [{"name": "y", "shape": [1, 4, width + 1], "parts": {"hand": [0, width]}, "convert": [step]}],
        "control_hz": 10, "chunk": 4,
    }  # fmt: skip
    converter = action_converter(PolicySpec.from_dict(data), None)  # type: ignore[arg-type]
    state, differences = transforms(1)[0], transforms(4)
    chunk = np.concatenate([values(differences, "6d_rows"), np.full((4, 1), 7.0)], axis=1).astype(np.float32)
    found = converter.to_robot(chunk, np.concatenate([[9.0], values(state, "6d_rows")]).astype(np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[:, :-1], values(state @ differences, "6d_rows"), atol=2e-6)
    np.testing.assert_array_equal(found[:, -1], 7)
