"""Commands of an arm as messages: a trajectory of one point, or a state that is wanted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vlatool.controllers._interface import Output
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Duration, Time
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import Header
from vlatool.messages.trajectory_msgs import JointTrajectory, JointTrajectoryPoint

OUTPUTS = {
    "trajectory": Output("trajectory", "/joint_trajectory_controller/joint_trajectory", JointTrajectory),
    "joint_state": Output("command", "/joint_commands", JointState),
}
"""Setting ``output`` -> topic."""


def command_messages(
    output: str, names: tuple[str, ...], positions: Sequence[float], stamp: Time, lead_s: float
) -> dict[str, tuple[Message, ...]]:
    """Return the messages of a command.

    Args:
        output: Key of ``OUTPUTS``.
        names: Joints, as the driver names them.
        positions: Of the joints, in that order.
        stamp: When the command was computed.
        lead_s: Time after the stamp at which a trajectory reaches the positions.
    """
    values, header = np.array(positions, np.float64), Header(stamp)
    if output == "joint_state":
        return {OUTPUTS[output].name: (JointState(header, names, values),)}
    point = JointTrajectoryPoint(positions=values, time_from_start=Duration.from_seconds(lead_s))
    return {OUTPUTS[output].name: (JointTrajectory(header, names, (point,)),)}
