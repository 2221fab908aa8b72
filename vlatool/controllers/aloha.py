"""ALOHA: two ViperX-300, each with a gripper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

from vlatool.controllers._arm import ArmController
from vlatool.controllers._arm_robot import ArmRobot
from vlatool.runtime.envelope import KeepApart
from vlatool.runtime.kinematics import VIPERX_CAPSULES, VIPERX_REACH_M, Chain, Clearance, Pose, arm

ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
JOINTS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in (*ARM, "gripper"))
POSE = (0.0, -0.96, 1.16, 0.0, -0.3, 0.0, 0.024)
CHAINS: Mapping[str, Chain] = {
    "left": replace(arm("viperx_300"), base=Pose((-0.469, 0.5, 0.0))),
    "right": replace(arm("viperx_300"), base=Pose((0.469, 0.5, 0.0), (-3.673205e-06, 0.0, 0.0, 1.0))),
}
"""Bases as in gym-aloha: 0.938 m apart, face to face; the right one is turned by 3.1416 rad, as written there."""


@dataclass(frozen=True)
class Aloha(ArmController):
    """ALOHA: the policy gives positions of 14 joints, those of the left arm first, 50 times in a second.

    They are ``left_waist``, ``left_shoulder``, ``left_elbow``, ``left_forearm_roll``, ``left_wrist_angle`` and
    ``left_wrist_rotate`` in rad, ``left_gripper`` in metres, and the same with ``right_``; messages have these names. A
    gripper is the position of its left finger from 0.021 (closed) to 0.057 (open), absolute in any mode. The start
    pose of each arm is that of gym-aloha: 0, -0.96, 1.16, 0, -0.3, 0, 0.024. Neither a command nor the stop behind it
    brings the arms nearer to each other than ``clearance_m``, by capsules around their links; what the arms lag behind
    their commands is within that.
    """

    speed: float = 0.25
    margin_rad: float = 0.04

    ROBOT: ClassVar[ArmRobot] = ArmRobot("aloha", JOINTS, JOINTS, POSE * 2, CHAINS)

    def _apart(self) -> KeepApart:
        left, right = (self.ROBOT.places(side) for side in ("left", "right"))
        capsules = (VIPERX_CAPSULES, VIPERX_CAPSULES)
        distance = Clearance((CHAINS["left"], CHAINS["right"]), (left, right), capsules)
        return KeepApart(distance, self.clearance_m, (*VIPERX_REACH_M, 0.0) * 2)
