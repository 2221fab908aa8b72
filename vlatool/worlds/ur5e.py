"""A UR5e in free space."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import ClassVar

from vlatool.worlds._arm_model import ModelFile
from vlatool.worlds._arm_servos import TorqueServos
from vlatool.worlds._arm_world import ArmSetup, ArmWorld, Tip

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


@dataclass
class Ur5e(ArmWorld):
    """A UR5e: model and motors of robosuite, without a tool; position control as the robot's own has it."""

    SETUP: ClassVar[ArmSetup] = ArmSetup(
        ModelFile("robosuite", "1.5.2", "robosuite/models/assets/robots/ur5e/robot.xml"),
        {f"{joint}_joint": f"{joint}_joint" for joint in JOINTS},
        (0.0, -pi / 2, pi / 2, -pi / 2, -pi / 2, 0.0),
        {"": Tip("right_hand")},
        TorqueServos,
    )
