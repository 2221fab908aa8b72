"""Kinematics of arms from tables: poses of links and tips, Jacobians, and how near two arms are to each other."""

from vlatool.runtime.kinematics.arms import ARMS, VIPERX_CAPSULES, VIPERX_REACH_M, arm
from vlatool.runtime.kinematics.chain import Chain, Link, Pose, from_modified_dh, from_standard_dh
from vlatool.runtime.kinematics.clearance import Capsule, Clearance, segment_distances

__all__ = [
    "ARMS", "VIPERX_CAPSULES", "VIPERX_REACH_M", "Capsule", "Chain", "Clearance", "Link", "Pose", "arm",
    "from_modified_dh", "from_standard_dh", "segment_distances",
]  # fmt: skip
