"""Arithmetic on actions with a rotation, a gripper and plain numbers, held against rotation matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlatool.bundle.spec import TensorSpec
from vlatool.runtime.action_elements import ActionElements, rotations_of
from vlatool.runtime.control.late import hold
from vlatool.runtime.rotation import convert_rotation, product, slerp
from vlatool.runtime.rungs import Hold

LABELS = ["x", "y", "z", *"abcd", "gripper"]
RANDOM = np.random.default_rng(3)


def action(mode: str = "absolute", form: str = "quaternion_xyzw", **more: Any) -> TensorSpec:
    width = {"quaternion_xyzw": 4, "axis_angle": 3}[form]
    step = {"op": "rotation", "parts": [[3, 3 + width]], "robot": form, "network": "6d_columns", **more}
    labels = [*LABELS[: 3 + width], "gripper"]
    return TensorSpec.from_dict({"name": "a", "shape": [1, 1, 10], "mode": mode, "labels": labels, "convert": [step]})


def values(form: str = "quaternion_xyzw") -> Any:
    turn = RANDOM.uniform(-1, 1, 3)
    turned = convert_rotation(turn, "axis_angle", form) * (RANDOM.choice([-1, 1]) if form != "axis_angle" else 1)
    return np.concatenate([RANDOM.normal(size=3), turned, [RANDOM.choice([-1, 1])]]).astype(np.float32)


def matrix(values: Any, form: str = "quaternion_xyzw") -> Any:
    return convert_rotation(np.asarray(values[3:-1], np.float64), form, "matrix").reshape(3, 3)


@pytest.mark.parametrize("form", ["quaternion_xyzw", "axis_angle"])
def test_parts_of_a_difference_make_the_whole(form: str):
    elements, whole = ActionElements(action("delta", form)), values(form)
    parts = [elements.part(whole, share) for share in (0.25, 0.5, 0.25)]
    total = elements.add(elements.add(parts[0], parts[1]), parts[2])
    np.testing.assert_allclose(total[:3], whole[:3], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(matrix(total, form), matrix(whole, form), atol=1e-5)
    assert {float(part[-1]) for part in parts} == {float(whole[-1])}


@pytest.mark.parametrize("form", ["quaternion_xyzw", "axis_angle"])
def test_a_mix_of_two_has_half_of_the_angle_between_them(form: str):
    elements, one, other = ActionElements(action("absolute", form)), values(form), values(form)
    half = elements.mix(one, other, 0.5)
    first, second = (matrix(each, form).T @ matrix(half, form) for each in (one, other))
    assert np.trace(first) == pytest.approx(np.trace(second), abs=1e-5)
    np.testing.assert_allclose(half[:3], (one[:3] + other[:3]) / 2, atol=1e-6)
    assert half[-1] == other[-1]
    np.testing.assert_array_equal(elements.mix(one, other, 0.0), one)
    np.testing.assert_array_equal(elements.mix(one, other, 1.0), other)


def test_what_is_shifted_by_no_difference_stays_and_by_one_follows():
    elements, one, two = ActionElements(action()), values(), values()
    np.testing.assert_allclose(matrix(elements.shift(one, two, two)), matrix(one), atol=1e-5)
    np.testing.assert_allclose(matrix(elements.shift(one, one, two)), matrix(two), atol=1e-5)
    np.testing.assert_allclose(elements.shift(one, one, two)[:3], two[:3], rtol=1e-5, atol=1e-6)


def test_no_motion_of_a_rotation_is_none_and_not_zeros():
    still = ActionElements(action("delta")).hold(values())
    np.testing.assert_array_equal(still[:-1], [0, 0, 0, 0, 0, 0, 1])
    last = values()
    np.testing.assert_array_equal(ActionElements(action("absolute")).hold(last), last)


def test_whoever_holds_a_delta_does_not_turn_it_into_no_rotation_at_all():
    delta, last = action("delta"), values().astype(np.float32)
    still = ActionElements(delta).hold(last)
    np.testing.assert_array_equal(hold(delta, last), still)
    np.testing.assert_array_equal(Hold(delta).act({}, last), still)
    np.testing.assert_array_equal(Hold(delta).act({}, None), [0, 0, 0, 0, 0, 0, 1, 0])


def test_rotations_are_those_of_the_robot_up_to_a_step_that_moves_the_places():
    pose = {"op": "relative", "to": "s", "parts": [[0, 6]], "pose": "axis_angle"}
    longer = {"op": "rotation", "parts": [[3, 6]], "robot": "axis_angle", "network": "6d_rows"}
    behind = {"op": "rotation", "parts": [[10, 13]], "robot": "axis_angle", "network": "euler_xyz"}
    before = {**behind, "parts": [[7, 10]]}
    said = {"name": "a", "shape": [1, 1, 13], "convert": [pose, before, longer, behind]}
    assert rotations_of(TensorSpec.from_dict(said)) == (((3, 6), "axis_angle"), ((7, 10), "axis_angle"))
    assert rotations_of(TensorSpec("a", (1, 1, 7))) == ()


def test_slerp_is_the_rotation_by_a_share_of_the_angle():
    turns = np.array([[0, 0, 0.4], [1.0, 0, 0], [0, np.pi - 1e-3, 0]])
    start = convert_rotation(RANDOM.uniform(-1, 1, (3, 3)), "axis_angle", "quaternion_xyzw")
    end = product(convert_rotation(turns, "axis_angle", "quaternion_xyzw"), start)
    for share in (0.0, 0.3, 1.0):
        partly = product(convert_rotation(turns * share, "axis_angle", "quaternion_xyzw"), start)
        for sign in (1, -1):
            np.testing.assert_allclose(np.abs((slerp(start, sign * end, share) * partly).sum(axis=-1)), 1, atol=1e-12)
