"""Franka Emika Panda (FER): seven joints, without a gripper."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import ClassVar

from vlatool.controllers._arm import ArmController
from vlatool.controllers._arm_robot import ArmRobot
from vlatool.runtime.kinematics import arm

JOINTS = tuple(f"joint{number}" for number in range(1, 8))


@dataclass(frozen=True)
class Franka(ArmController):
    """Franka Emika Panda: the policy gives positions of ``joint1`` to ``joint7`` in rad.

    In messages they are ``panda_joint1`` to ``panda_joint7`` (franka_ros; an FR3 has other limits). 50 steps in a
    second, between which the driver interpolates. No gripper: Franka's is an action of its own. The start
    pose is that of franka_ros: 0, -pi/4, 0, -3 pi/4, 0, pi/2, pi/4. Commands use half of the limits of acceleration:
    with all of them, hostile ones asked the arm, stretched out, for more torque than the motors of its shoulder have.
    """

    acceleration: float = 0.5
    margin_rad: float = 0.05

    ROBOT: ClassVar[ArmRobot] = ArmRobot(
        "franka-panda",
        JOINTS,
        tuple(f"panda_{joint}" for joint in JOINTS),
        (0.0, -pi / 4, 0.0, -3 * pi / 4, 0.0, pi / 2, pi / 4),
        {"": arm("franka_panda")},
    )
