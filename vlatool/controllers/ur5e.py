"""Universal Robots UR5e: six joints, without a gripper."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import ClassVar

from vlatool.controllers._arm import ArmController
from vlatool.controllers._arm_robot import ArmRobot
from vlatool.runtime.kinematics import arm

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


@dataclass(frozen=True)
class Ur5e(ArmController):
    """Universal Robots UR5e: the policy gives positions of ``shoulder_pan`` to ``wrist_3`` in rad.

    In messages each has ``_joint`` behind its name (ur_robot_driver, whose JointState is in another order: by name,
    that does not matter). 50 steps in a second, between which the driver interpolates. No gripper: a tool has a driver
    of its own. The start pose is 0, -pi/2, pi/2, -pi/2, -pi/2, 0: upper arm up, forearm ahead, tool down.
    """

    ROBOT: ClassVar[ArmRobot] = ArmRobot(
        "ur5e",
        JOINTS,
        tuple(f"{joint}_joint" for joint in JOINTS),
        (0.0, -pi / 2, pi / 2, -pi / 2, -pi / 2, 0.0),
        {"": arm("ur5e")},
    )
