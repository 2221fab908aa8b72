"""Messages are values that are compared bit for bit and found by either name."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from vlatool.errors import UsageError
from vlatool.messages import all_types, find_type, same
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.sensor_msgs import Image, JointState, LaserScan


def test_found_by_both_names() -> None:
    assert find_type("geometry_msgs/msg/Twist") is Twist is find_type("geometry_msgs/Twist")


def test_found_before_its_package_is_imported() -> None:
    """By a process that has imported nothing else, in either name of a part of a service."""
    code = (
        "from vlatool.messages import find_type\n"
        "assert find_type('std_srvs/SetBoolRequest') is find_type('std_srvs/srv/SetBool_Request')\n"
        "assert find_type('vlatool_msgs/action/RunInstruction_Goal').TYPE.endswith('Goal')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_type_has_defaults_and_a_docstring() -> None:
    kinds = all_types()
    assert {"sensor_msgs/msg/Image", "std_srvs/srv/Trigger_Request", "tf2_msgs/msg/TFMessage"} <= {
        k.TYPE for k in kinds
    }
    assert all(same(kind(), kind()) and kind.__doc__ for kind in kinds)


def test_unknown_type_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="geometry_msgs/msg/Twist"):
        find_type("geometry_msgs/Twits")
    with pytest.raises(UsageError, match=r"Unknown type of message '\.\.'"):
        find_type("..")


def test_equal_bit_for_bit() -> None:
    assert same(Twist(linear=Vector3(x=float("nan"))), Twist(linear=Vector3(x=float("nan"))))
    assert not same(Twist(), Twist(linear=Vector3(x=1e-300)))
    assert not same(Twist(), Twist(linear=Vector3(x=-0.0)))
    assert not same(JointState(name=("a",)), JointState(name=("a", "b")))
    assert same(Image(), Image())
    assert not same(Image(data=np.zeros(3, np.uint8)), Image(data=np.zeros(4, np.uint8)))
    assert not same(LaserScan(ranges=np.zeros(2, np.float32)), LaserScan(ranges=np.zeros(2)))


@pytest.mark.parametrize("seconds", [0.0, 1.5, 1e9 + 0.25, -0.25])
def test_moment_of_seconds(seconds: float) -> None:
    moment = Time.from_seconds(seconds)
    assert moment.seconds == pytest.approx(seconds, abs=1e-9)
    assert 0 <= moment.nanosec < 1_000_000_000
