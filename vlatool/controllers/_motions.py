"""Labels of a policy as motions of a differential drive, which odometry ends."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from vlatool.controllers._geometry import PlanarPose, clamp, wrap
from vlatool.errors import UsageError

TURN_LEFT, TURN_RIGHT, FORWARD, BACKWARD, WAIT, STOP = "left", "right", "forward", "backward", "wait", "stop"
WORDS = {
    TURN_LEFT: ("left",), TURN_RIGHT: ("right",), FORWARD: ("forward", "forwards", "ahead", "straight"),
    BACKWARD: ("back", "backward", "backwards", "reverse"), WAIT: ("wait", "none", "noop", "idle", "hold"),
    STOP: ("stop", "done", "end", "arrived"),
}  # fmt: skip
"""Motion -> words of a label that ask for it."""
TURN_GAIN, DRIVE_GAIN, SIDE_GAIN = 2.0, 1.5, 3.0
"""Rotation speed for an angle that is left and speed for a distance that is left, in 1/s; rotation for a distance to
the side, in rad/s for a metre."""


def motions_of(labels: Sequence[str], mapping: str = "") -> tuple[str, ...]:
    """Return the motion of each label of a policy.

    Args:
        labels: Names of the actions, such as ``turn left`` or ``MOVE_FORWARD``.
        mapping: ``LABEL=MOTION`` for labels that do not say it themselves, separated by commas.

    Raises:
        UsageError: for a label that asks for no motion or for several, or an unknown motion.
    """
    named = {}
    for entry in filter(None, (part.strip() for part in mapping.split(","))):
        label, _, motion = (part.strip() for part in entry.partition("="))
        if motion not in WORDS:
            raise UsageError.unknown(f"Unknown motion '{motion}' for the label '{label}'", motion, WORDS)
        named[label] = motion
    if absent := [label for label in named if label not in labels]:
        raise UsageError.unknown(f"The policy has no label '{absent[0]}'", absent[0], labels)
    return tuple(named.get(label) or _motion_of(label) for label in labels)


def _motion_of(label: str) -> str:
    words = set(re.split(r"[^a-z0-9]+", label.lower()))
    found = [motion for motion, known in WORDS.items() if words & set(known)]
    if len(found) != 1:
        asks = f"asks for {' and '.join(found)}" if found else "asks for no motion"
        raise UsageError(
            f"The label '{label}' of the policy {asks}; known motions: {', '.join(WORDS)}.",
            f"say what it means with motions='{label}={FORWARD}', or another motion",
        )
    return found[0]


class Motion(NamedTuple):
    """A motion under way.

    Args:
        kind: ``left``, ``right``, ``forward`` or ``backward``.
        goal: Pose at its end, in the frame of the odometry.
        began_s: When it began, in seconds of ``Snapshot.time_s``.
    """

    kind: str
    goal: PlanarPose
    began_s: float


def plan(kind: str, start: PlanarPose, turn_rad: float, forward_m: float, time_s: float) -> Motion:
    """Return a motion from a pose."""
    if kind in (TURN_LEFT, TURN_RIGHT):
        yaw = wrap(start.yaw + (turn_rad if kind == TURN_LEFT else -turn_rad))
        return Motion(kind, start._replace(yaw=yaw), time_s)
    distance = forward_m if kind == FORWARD else -forward_m
    x, y = start.x + distance * math.cos(start.yaw), start.y + distance * math.sin(start.yaw)
    return Motion(kind, PlanarPose(x, y, start.yaw), time_s)


class Speeds(NamedTuple):
    """Limits of motions.

    Args:
        linear: Largest speed, in m/s.
        angular: Largest rotation speed, in rad/s.
        position_m: Distance from its goal at which a motion ends, in metres.
        angle_rad: Angle from its goal at which a motion ends, in radians.
    """

    linear: float
    angular: float
    position_m: float
    angle_rad: float


def drive(motion: Motion, pose: PlanarPose, speeds: Speeds) -> tuple[float, float, bool]:
    """Return the speed in m/s, the rotation speed in rad/s, and whether the motion is at its end."""
    goal = motion.goal
    turn = wrap(goal.yaw - pose.yaw)
    if motion.kind in (TURN_LEFT, TURN_RIGHT):
        if abs(turn) <= speeds.angle_rad:
            return 0.0, 0.0, True
        return 0.0, clamp(_at_least(TURN_GAIN * turn, 0.1 * speeds.angular), speeds.angular), False
    cos, sin = math.cos(goal.yaw), math.sin(goal.yaw)
    ahead = (goal.x - pose.x) * cos + (goal.y - pose.y) * sin
    side = (goal.y - pose.y) * cos - (goal.x - pose.x) * sin
    sign = 1.0 if motion.kind == FORWARD else -1.0
    if sign * ahead <= speeds.position_m:
        return 0.0, 0.0, True
    linear = clamp(_at_least(DRIVE_GAIN * ahead, 0.1 * speeds.linear), speeds.linear)
    return linear, clamp(TURN_GAIN * turn + sign * SIDE_GAIN * side, speeds.angular), False


def _at_least(value: float, magnitude: float) -> float:
    return math.copysign(max(abs(value), magnitude), value)
