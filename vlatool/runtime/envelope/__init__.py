"""The action envelope of a robot: every command within its limits, and a proven stop at each step.

Not a safety-rated function: it belongs above a robot's own safety controller, not in its place.
"""

from vlatool.runtime.envelope.envelope import Envelope, StepResult
from vlatool.runtime.envelope.keep_apart import KeepApart
from vlatool.runtime.envelope.limits import Box, JointLimits, RobotLimits, VelocityCurve, robot_names
from vlatool.runtime.envelope.monitor import Level, Monitor
from vlatool.runtime.envelope.of_spec import check_position, envelope_of

__all__ = [
    "Box", "Envelope", "JointLimits", "KeepApart", "Level", "Monitor", "RobotLimits", "StepResult", "VelocityCurve",
    "check_position", "envelope_of", "robot_names",
]  # fmt: skip
