"""Actions of a policy to the messages that a robot obeys."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.controllers._policy_map import OutputMap
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Duration, Time
from vlatool.messages.geometry_msgs import Twist, TwistStamped, Vector3
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import Header
from vlatool.messages.trajectory_msgs import JointTrajectory, JointTrajectoryPoint

Array = NDArray[Any]
CHECK = "check the bundle: vlatool explain BUNDLE"


def check_action(output: OutputMap, action: Array) -> None:
    """Raise BusError for an action that commands no number, has another number of elements, or has no label."""
    values = np.asarray(action, np.float64).reshape(-1)
    if output.labels:
        if len(values) != 1 or not 0 <= values[0] < len(output.labels):
            raise BusError(f"The policy's action {values.tolist()!s:.40} has no label.", CHECK)
    elif len(values) <= max(output.indices, default=-1):
        raise BusError(f"The policy's action has {len(values)} numbers; {len(output.indices)} are mapped.", CHECK)
    elif not np.isfinite(values[list(output.indices)]).all():
        raise BusError("The policy's action is not finite.", CHECK)


def message_of(
    output: OutputMap, action: Array, stamp: Time, period_s: float, positions: Array | None = None
) -> Message:
    """Return what an action commands.

    Args:
        action: (A,) in the units of the spec, or a 0-d index of a discrete action.
        stamp: Moment of the step.
        period_s: Time until the next action, in which a trajectory reaches its point.
        positions: (N,) of the joints that are commanded, in SI units, to which a delta is added.
    """
    header = Header(stamp, output.frame)
    if output.message in (Twist, TwistStamped):
        return _twist(output, _speeds(output, action), header)
    values = np.asarray(action, np.float64).reshape(-1)[list(output.indices)] * np.array(output.scales)
    if output.mode == "delta":
        values = values + np.asarray(positions, np.float64)
    return _joints(output, header, values, output.mode == "velocity", period_s)


def _speeds(output: OutputMap, action: Array) -> Mapping[str, float]:
    if output.labels:
        return output.labels[int(np.asarray(action).reshape(-1)[0])]
    values = np.asarray(action, np.float64).reshape(-1)
    return {name: float(values[index]) * scale
            for index, name, scale in zip(output.indices, output.names, output.scales, strict=True)}  # fmt: skip


def _twist(output: OutputMap, speeds: Mapping[str, float], header: Header) -> Message:
    parts = {part: Vector3(**{axis: speeds.get(f"{part}.{axis}", 0.0) for axis in "xyz"})
             for part in ("linear", "angular")}  # fmt: skip
    twist = Twist(**parts)
    return twist if output.message is Twist else TwistStamped(header, twist)


def _joints(output: OutputMap, header: Header, values: Array, velocity: bool, period_s: float) -> Message:
    if output.message is JointState:
        return JointState(header, output.names, **{"velocity" if velocity else "position": values})
    kind = "velocities" if velocity else "positions"
    point = JointTrajectoryPoint(**{kind: values}, time_from_start=Duration.from_seconds(period_s))
    return JointTrajectory(Header(Time(), output.frame), output.names, (point,))


def stop_of(output: OutputMap, stamp: Time, positions: Array | None = None) -> tuple[Message, ...]:
    """Return what stops the robot: no speed; for positions an empty trajectory, at which ros2_control's joint
    trajectory controller stops, or the positions where the joints are, or nothing where those are unknown.
    """
    header = Header(stamp, output.frame)
    if output.message in (Twist, TwistStamped):
        return (_twist(output, {}, header),)
    if output.message is JointTrajectory:
        return (JointTrajectory(Header(Time(), output.frame), output.names),)
    if output.mode == "velocity":
        return (_joints(output, header, np.zeros(len(output.names)), True, 0.0),)
    return () if positions is None else (_joints(output, header, positions, False, 0.0),)
