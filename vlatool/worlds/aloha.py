"""ALOHA: two ViperX-300 at a table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.worlds._arm_model import ModelFile
from vlatool.worlds._arm_servos import PositionServos
from vlatool.worlds._arm_world import ArmSetup, ArmWorld, Mirror, Tip

ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
SIDES = ("left", "right")


@dataclass
class Aloha(ArmWorld):
    """ALOHA: model and servos of gym-aloha's table with a cube; a gripper's position is that of its left finger."""

    SETUP: ClassVar[ArmSetup] = ArmSetup(
        ModelFile("gym-aloha", "0.1.5", "gym_aloha/assets/bimanual_viperx_transfer_cube.xml"),
        {
            f"{side}_{joint}": f"vx300s_{side}/{'left_finger' if joint == 'gripper' else joint}"
            for side in SIDES
            for joint in (*ARM, "gripper")
        },
        (0.0, -0.96, 1.16, 0.0, -0.3, 0.0, 0.024) * 2,
        {side: Tip(f"vx300s_{side}/gripper_link", (0.15, 0.0, 0.0)) for side in SIDES},
        PositionServos,
        tuple(Mirror(f"vx300s_{side}/right_finger", f"{side}_gripper", -1.0) for side in SIDES),
        ("vx300s_left", "vx300s_right"),
    )
