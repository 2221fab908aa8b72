"""Joints are found by their names."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from vlatool.errors import BusError
from vlatool.messages.joints import joint_values
from vlatool.messages.sensor_msgs import JointState

VALUES = {"pan": 0.1, "lift": -0.2, "elbow": float("nan"), "grip": 4.0}


def test_order_does_not_matter() -> None:
    for names in itertools.permutations(VALUES):
        state = JointState(name=names, position=np.array([VALUES[name] for name in names]))
        np.testing.assert_array_equal(joint_values(state, ("grip", "pan", "elbow")), [4.0, 0.1, np.nan])


def test_each_quantity() -> None:
    state = JointState(name=("a", "b"), velocity=np.array([1.0, 2.0]), effort=np.array([3.0, 4.0]))
    assert joint_values(state, ["b", "a"], "velocity").tolist() == [2.0, 1.0]
    assert joint_values(state, ["b"], "effort").tolist() == [4.0]
    assert joint_values(state, [], "effort").shape == (0,)
    with pytest.raises(BusError, match="2 names and 0 values of position"):
        joint_values(state, ["a"])
    with pytest.raises(BusError, match="no 'torque'"):
        joint_values(state, ["a"], "torque")


def test_missing_and_doubled_joints_are_named() -> None:
    state = JointState(name=("a", "b", "a"), position=np.array([1.0, 2.0, 3.0]))
    assert joint_values(state, ["b"]).tolist() == [2.0]
    with pytest.raises(BusError, match="2 times with the joint 'a'"):
        joint_values(state, ["b", "a"])
    with pytest.raises(BusError, match="without the joint 'c'; its joints: a, b, a"):
        joint_values(state, ["b", "c"])
    with pytest.raises(BusError, match="its joints: none"):
        joint_values(JointState(), ["c"])


def test_names_of_joints_are_shown_in_part() -> None:
    with pytest.raises(BusError) as refused:
        joint_values(JointState(name=("n" * 10_000, "m" * 10_000), position=np.zeros(2)), ["a"])
    assert len(refused.value.message) < 500
