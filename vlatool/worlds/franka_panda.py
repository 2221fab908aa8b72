"""A Franka Panda in free space."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import ClassVar

from vlatool.worlds._arm_model import ModelFile
from vlatool.worlds._arm_servos import TorqueServos
from vlatool.worlds._arm_world import ArmSetup, ArmWorld, Tip


@dataclass
class FrankaPanda(ArmWorld):
    """A Franka Panda: model and motors of robosuite, without a gripper; position control as the robot's own has it."""

    SETUP: ClassVar[ArmSetup] = ArmSetup(
        ModelFile("robosuite", "1.5.2", "robosuite/models/assets/robots/panda/robot.xml"),
        {f"panda_joint{number}": f"joint{number}" for number in range(1, 8)},
        (0.0, -pi / 4, 0.0, -3 * pi / 4, 0.0, pi / 2, pi / 4),
        {"": Tip("link7", (0.0, 0.0, 0.107))},
        TorqueServos,
    )
