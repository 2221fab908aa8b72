"""What the controller vln remembers from step to step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from numpy.typing import NDArray

from vlatool.controllers._freshness import Change
from vlatool.controllers._geometry import PlanarPose
from vlatool.controllers._motions import Motion

IDLE_PHASE, RUNNING_PHASE, PAUSED_PHASE, ARRIVED_PHASE, FAILED_PHASE = "idle", "running", "paused", "arrived", "failed"
"""First word of the status."""


class VlnState(NamedTuple):
    """State of the controller.

    Args:
        phase: One of the words above.
        detail: What it does or why it stands, for the status.
        instruction: What the policy is asked to do.
        heard: Number of the message with the instruction; -1 before the first.
        motion: The motion under way.
        has_arrived: Whether the word came that the robot arrived.
        waypoint: Pose at which the last motion was to end, in the frame of the odometry; None before the first.
        ended_s: When the last motion ended or the instruction came, in seconds of ``Snapshot.time_s``.
        ended_stamp: Stamp of the newest odometry then, in seconds.
        rest_stamp: Stamp of the first odometry from then on by which the robot stands, in seconds; None before it.
        frame_s: When the first frame of the standing robot came, in seconds of ``Snapshot.time_s``; None before it.
        frames: Last frames that the policy saw, uint8 (H, W, 3) each.
        actions: Indices of all actions since the instruction.
        changes: When camera, odometry and depth last changed.
    """

    phase: str = IDLE_PHASE
    detail: str = ""
    instruction: str = ""
    heard: int = -1
    motion: Motion | None = None
    has_arrived: bool = False
    waypoint: PlanarPose | None = None
    ended_s: float = 0.0
    ended_stamp: float = 0.0
    rest_stamp: float | None = None
    frame_s: float | None = None
    frames: tuple[NDArray[Any], ...] = ()
    actions: tuple[int, ...] = ()
    changes: Mapping[str, Change] = {}
