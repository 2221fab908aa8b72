"""Limits of a robot: what its joints or axes may do, and boxes that Cartesian commands stay in or out of.

The robots that are known by name are in ``robots.json``, which ``vlatool.hardware.robots`` writes from
``profiles/robots/*.yaml``; those files have a source for each limit, and say which limits are assumptions.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, replace
from math import degrees, inf, sqrt
from pathlib import Path
from typing import Any

from vlatool.errors import ProfileError
from vlatool.files.json import read_json
from vlatool.files.validate import short_repr

ROBOTS = Path(__file__).with_name("robots.json")
MAX_LIMIT = 1e6
"""Largest limit, in SI units: nothing that a policy moves is faster, and a larger number is a typing error."""
MAX_FILE_BYTES = 1 << 20
ROUNDING = 5e-10
"""Velocity, in units/s, by which rounding may exceed a curve."""
COMMANDS = ("", "velocity", "range")
SPACES = ("joint", "cartesian")


@dataclass(frozen=True)
class VelocityCurve:
    """Velocity limits that depend on the position, as the FR3 has them (libfranka's ``rate_limiting.h``).

    Upwards, the limit at q is ``max(0, sqrt(max(0, slope (high - q))) - offset)``; downwards the same with q - low.

    Args:
        offset: in units/s.
        slope: in units/s^2.
        low: position at which the root of the limit downwards is 0.
        high: position at which the root of the limit upwards is 0.
    """

    offset: float
    slope: float
    low: float
    high: float

    def __post_init__(self) -> None:
        for name in ("offset", "slope", "low", "high"):
            _number(getattr(self, name), f"The velocity curve's {name}")
        if self.offset < 0 or self.slope <= 0 or not self.low < self.high:
            raise _refusal(f"A velocity curve has {self}; allowed: offset from 0, slope above 0, low below high.")

    def upper(self, position: float) -> float:
        """Return the largest velocity at a position, from 0, in units/s."""
        return max(0.0, sqrt(max(0.0, self.slope * (self.high - position))) - self.offset)

    def lower(self, position: float) -> float:
        """Return the least (most negative) velocity at a position, up to 0, in units/s."""
        return -max(0.0, sqrt(max(0.0, self.slope * (position - self.low))) - self.offset)

    def allows(self, position: float, velocity: float) -> bool:
        """Return whether a velocity is allowed at a position, up to rounding."""
        return self.lower(position) - ROUNDING <= velocity <= self.upper(position) + ROUNDING


@dataclass(frozen=True)
class JointLimits:
    """What one joint or axis may do.

    Args:
        name: as in the labels of the action.
        unit: of its position: ``rad``, ``m`` or ``1``.
        low: least position; None for a wheel, or any axis that only the workspace bounds.
        high: greatest position; None as for ``low``.
        velocity: least and greatest velocity, in units/s.
        acceleration: largest magnitude, in units/s^2.
        jerk: largest magnitude, in units/s^3.
        command: ``velocity`` for an axis that takes velocities whatever the mode of the action is, such as a mobile
            base; ``range`` for one that is commanded by position alone and whose motion the hardware limits, such as
            a gripper (``velocity``, ``acceleration`` and ``jerk`` are then unused); else empty.
        curve: velocity limits that depend on the position, beside ``velocity``.

    Raises:
        ProfileError: when a limit is missing, not finite, has the wrong sign or is absurd.
    """

    name: str
    unit: str = "rad"
    low: float | None = None
    high: float | None = None
    velocity: tuple[float, float] = (0.0, 0.0)
    acceleration: float = 0.0
    jerk: float = 0.0
    command: str = ""
    curve: VelocityCurve | None = None

    def __post_init__(self) -> None:
        where = f"The joint {short_repr(self.name)}"
        if not isinstance(self.name, str) or not self.name or self.command not in COMMANDS:
            raise _refusal(f"{where} has the command {short_repr(self.command)}; allowed: velocity, range or none.")
        if (self.low is None) != (self.high is None) or (self.command == "range" and self.low is None):
            raise _refusal(f"{where} has one of two position limits.")
        low, high = self.bounds
        if self.low is not None and not _number(low, f"{where}'s low") < _number(high, f"{where}'s high"):
            raise _refusal(f"{where} has low {low:g} and high {high:g}; low must be below high.")
        if self.command != "range":
            self._check_motion(where)

    def _check_motion(self, where: str) -> None:
        slow, fast = (_number(value, f"{where}'s velocity") for value in self.velocity)
        for name in ("acceleration", "jerk"):
            if _number(getattr(self, name), f"{where}'s {name}") <= 0:
                raise _refusal(f"{where} has the {name} {getattr(self, name):g}; it must be above 0.")
        if not slow <= 0 <= fast or slow == fast:
            raise _refusal(f"{where} may move at {slow:g} to {fast:g}; the range must include 0 and more.")

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest position; infinite without limits."""
        return (-inf if self.low is None else self.low), (inf if self.high is None else self.high)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> JointLimits:
        """Build the limits from a mapping as in ``robots.json``."""
        values = _fields(cls, data)
        if isinstance(values.get("velocity"), int | float):
            values["velocity"] = (-values["velocity"], values["velocity"])
        velocity = values.get("velocity", (0.0, 0.0))
        if not isinstance(velocity, list | tuple) or len(velocity) != 2:
            raise _refusal(f"A velocity limit is {short_repr(velocity)}; it must be a number, or two: least, greatest.")
        values["velocity"] = tuple(velocity)
        if values.get("curve") is not None:
            values["curve"] = VelocityCurve(**_fields(VelocityCurve, values["curve"]))
        return cls(**values)


@dataclass(frozen=True)
class Box:
    """A box along some axes of Cartesian commands.

    Args:
        low: axis -> least position.
        high: axis -> greatest position; the same axes.

    Raises:
        ProfileError: when a side is missing, not finite or without length.
    """

    low: Mapping[str, float]
    high: Mapping[str, float]

    def __post_init__(self) -> None:
        if set(self.low) != set(self.high) or not self.low:
            raise _refusal(f"A box has low {short_repr([*self.low])} and high {short_repr([*self.high])} sides.")
        for axis in self.low:
            if not _number(self.low[axis], f"A box's low {axis}") < _number(self.high[axis], f"A box's high {axis}"):
                raise _refusal(f"A box has low {self.low[axis]} and high {self.high[axis]} along {axis}.")


@dataclass(frozen=True)
class RobotLimits:
    """Limits of a robot, in the order of the elements of its action.

    Args:
        name: of the robot.
        joints: one for each element of the action.
        space: ``joint``, or ``cartesian`` where the elements are axes of a space; only those have boxes.
        keep_out: boxes that neither a command nor the stop behind it enters.
        assumed: ``joint.limit`` of those limits that nobody published.

    Raises:
        ProfileError: when there are none, or two of one name.

    Example:
        >>> RobotLimits.named("franka-panda").joints[0].acceleration
        15.0
    """

    name: str
    joints: tuple[JointLimits, ...]
    space: str = "joint"
    keep_out: tuple[Box, ...] = ()
    assumed: frozenset[str] = field(default=frozenset())

    def __post_init__(self) -> None:
        names = [joint.name for joint in self.joints]
        if not names or len({*names}) < len(names) or self.space not in SPACES:
            raise _refusal(f"The robot '{self.name}' has the joints {short_repr(names)} in {short_repr(self.space)}.")
        for box in self.keep_out:
            self._check_axes(box)

    @classmethod
    def named(cls, name: str) -> RobotLimits:
        """Return the limits of a robot by name; raises ProfileError for an unknown one, with the known ones."""
        known = _robots(ROBOTS)
        if name not in known:
            raise ProfileError.unknown(f"Unknown robot '{name}'", name, known)
        return cls.from_dict(known[name] | {"name": name})

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> RobotLimits:
        """Read the limits of a robot from a JSON file: one robot as in ``robots.json``, with its ``name``.

        Raises:
            ProfileError: when the file cannot be read, or a limit in it is missing, not a number or absurd.
        """
        return cls.from_dict(_read(Path(path)))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RobotLimits:
        """Build the limits from a mapping as in ``robots.json``, with a ``name``."""
        values = _fields(cls, data)
        joints, boxes = values.get("joints"), values.get("keep_out", ())
        if not isinstance(joints, list | tuple) or not isinstance(boxes, list | tuple):
            raise _refusal("A robot needs 'joints', a list.")
        values["joints"] = tuple(JointLimits.from_dict(joint) for joint in joints)
        values["keep_out"] = tuple(Box(**_fields(Box, box)) for box in boxes)
        values["assumed"] = frozenset(values.get("assumed", ()))
        return cls(**values)

    def within(self, workspace: Box) -> RobotLimits:
        """Return these limits with positions that stay in a workspace or geofence, too."""
        self._check_axes(workspace)
        return replace(self, joints=tuple(_bounded(joint, workspace) for joint in self.joints))

    def outside(self, *boxes: Box) -> RobotLimits:
        """Return these limits with further boxes to keep out of."""
        return replace(self, keep_out=(*self.keep_out, *boxes))

    def slower(self, fraction: float) -> RobotLimits:
        """Return these limits with velocities of a fraction (above 0, up to 1); positions and the rest stay."""
        if not 0 < _number(fraction, "The fraction") <= 1:
            raise _refusal(f"The fraction of the velocities is {fraction}; allowed: above 0, up to 1.")
        joints = [replace(joint, velocity=_scaled(joint.velocity, fraction)) for joint in self.joints]
        return replace(self, joints=tuple(joints))

    def gentler(self, fraction: float) -> RobotLimits:
        """Return these limits with accelerations and jerks of a fraction (above 0, up to 1); the rest stays."""
        if not 0 < _number(fraction, "The fraction") <= 1:
            raise _refusal(f"The fraction of the accelerations is {fraction}; allowed: above 0, up to 1.")
        joints = [
            replace(joint, acceleration=fraction * joint.acceleration, jerk=fraction * joint.jerk)
            for joint in self.joints
        ]
        return replace(self, joints=tuple(joints))

    def plus(self, *joints: JointLimits) -> RobotLimits:
        """Return these limits with further joints at the end, such as a gripper."""
        return replace(self, joints=(*self.joints, *joints))

    def in_order(self, names: Sequence[str]) -> RobotLimits:
        """Return the limits of some joints, in an order; raises ProfileError for an unknown one."""
        known = {joint.name: joint for joint in self.joints}
        for name in names:
            if name not in known:
                raise ProfileError.unknown(f"'{self.name}' has no joint '{name}'", name, known)
        return replace(self, joints=tuple(known[name] for name in names))

    def in_degrees(self) -> RobotLimits:
        """Return these limits with degrees for radians; metres stay."""
        return replace(self, joints=tuple(_in_degrees(joint) for joint in self.joints))

    def _check_axes(self, box: Box) -> None:
        known = {joint.name for joint in self.joints}
        if self.space != "cartesian" or not {*box.low} <= known:
            raise ProfileError(
                f"A box along {', '.join(sorted(box.low))} does not fit '{self.name}', whose commands are in "
                f"{self.space} space: {', '.join(sorted(known))}.",
                "boxes bound Cartesian commands, along axes of these names; bound joints by their positions",
            )


def robot_names() -> list[str]:
    """List the robots that ``RobotLimits.named`` knows."""
    return sorted(_robots(ROBOTS))


def _robots(path: Path) -> dict[str, dict[str, Any]]:
    return _read(path)


def _read(path: Path) -> dict[str, Any]:
    """Return a JSON file's mapping; raises ProfileError when it is none, or too large."""
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ProfileError(f"The limits {path} cannot be read: {error.strerror}.", "name a JSON file") from error
    if len(content) > MAX_FILE_BYTES:
        raise ProfileError(f"The limits {path} have more than {MAX_FILE_BYTES} bytes.", "name a file of limits")
    data = read_json(content, f"The file {path}", ProfileError, "correct it in the file", strict=True)
    if not isinstance(data, dict):
        raise ProfileError(f"The file {path} holds {short_repr(data)}; a robot is a mapping.", "correct it in the file")
    return data


def _bounded(joint: JointLimits, box: Box) -> JointLimits:
    if joint.name not in box.low:
        return joint
    low, high = joint.bounds
    return replace(joint, low=max(low, box.low[joint.name]), high=min(high, box.high[joint.name]))


def _scaled(velocity: tuple[float, float], factor: float) -> tuple[float, float]:
    return factor * velocity[0], factor * velocity[1]


def _in_degrees(joint: JointLimits) -> JointLimits:
    if joint.unit != "rad":
        return joint
    low, high = (None if value is None else degrees(value) for value in (joint.low, joint.high))
    curve = joint.curve
    if curve is not None:
        bounds = degrees(curve.low), degrees(curve.high)
        curve = VelocityCurve(degrees(curve.offset), degrees(curve.slope), *bounds)
    return replace(
        joint, unit="deg", low=low, high=high, velocity=_scaled(joint.velocity, degrees(1)),
        acceleration=degrees(joint.acceleration), jerk=degrees(joint.jerk), curve=curve,
    )  # fmt: skip


def _fields(kind: Any, data: Any) -> dict[str, Any]:
    """Return a mapping whose keys are fields of a class; raises ProfileError otherwise."""
    known = set(kind.__dataclass_fields__)
    required = {name for name, item in kind.__dataclass_fields__.items() if _is_required(item)}
    if not isinstance(data, Mapping) or not required <= set(data) <= known:
        raise _refusal(
            f"Limits of a robot are {short_repr(data)}; {kind.__name__} needs {', '.join(sorted(required))} and takes "
            f"{', '.join(sorted(known - required)) or 'nothing else'}."
        )
    return dict(data)


def _is_required(item: Any) -> bool:
    return item.default is MISSING and item.default_factory is MISSING


def _number(value: Any, where: str) -> float:
    """Return a finite number that is not absurd."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not -MAX_LIMIT < value < MAX_LIMIT:
        raise _refusal(f"{where} is {short_repr(value)}; it must be a number of magnitude below {MAX_LIMIT:g}.")
    return float(value)


def _refusal(message: str) -> ProfileError:
    return ProfileError(message, "correct the limits; profiles/robots/ shows what belongs there")
