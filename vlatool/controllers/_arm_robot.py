"""What the controller of arms knows of a robot: joints, names of its driver, limits, start pose, chains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import UsageError
from vlatool.runtime.envelope import JointLimits, RobotLimits
from vlatool.runtime.kinematics import Chain

Array = NDArray[Any]


@dataclass(frozen=True)
class ArmRobot:
    """A robot of one arm or two.

    Args:
        name: In the table of limits, such as ``franka-panda``.
        joints: Names in the table of limits, in the order of the policy's action.
        driver_names: Names of the same joints in a JointState of its driver, in the same order.
        start: Pose to which it returns, in the units of the limits.
        chains: Arm -> its chain, with its base in the world; the name is empty where there is one.
        narrower: Joint -> least and greatest position, where a model says less than the table.
    """

    name: str
    joints: tuple[str, ...]
    driver_names: tuple[str, ...]
    start: tuple[float, ...]
    chains: Mapping[str, Chain]
    narrower: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def limits(self, speed: float = 1.0, margin: float = 0.0, acceleration: float = 1.0) -> RobotLimits:
        """Return the limits of its joints, in their order.

        Args:
            speed: Share of the velocities, above 0, up to 1.
            margin: By how much positions stay away from their limits, in rad; grippers may go to the end.
            acceleration: Share of the accelerations and jerks, above 0, up to 1.
        """
        limits = RobotLimits.named(self.name).in_order(self.joints).slower(speed).gentler(acceleration)
        return replace(limits, joints=tuple(self._narrowed(joint, margin) for joint in limits.joints))

    def _narrowed(self, joint: JointLimits, margin: float) -> JointLimits:
        least, greatest = self.narrower.get(joint.name, joint.bounds)
        low, high = max(joint.bounds[0], least), min(joint.bounds[1], greatest)
        if joint.command == "range":
            return replace(joint, low=low, high=high)
        return replace(joint, low=low + margin, high=high - margin)

    def tips(self, positions: Array) -> dict[str, Array]:
        """Return the place of each tip in the world in metres (3,), for positions of all joints (A,)."""
        return {name: chain.tip_position(positions[self.places(name)]) for name, chain in self.chains.items()}

    def places(self, name: str) -> list[int]:
        """Return the places of the joints of an arm's chain in the vector of all joints."""
        prefix = f"{name}_" if name else ""
        return [self.joints.index(prefix + joint) for joint in self.chains[name].joints]


def start_pose(robot: ArmRobot, wanted: Sequence[float], limits: RobotLimits) -> tuple[float, ...]:
    """Return the start pose: the robot's, unless another one is wanted.

    Raises:
        UsageError: when it has another length, or is outside of the limits.
    """
    pose = tuple(float(value) for value in wanted) or robot.start
    if len(pose) != len(robot.joints):
        raise UsageError(
            f"start_pose has {len(pose)} numbers; allowed: {len(robot.joints)}, one for each joint.",
            f"give {', '.join(robot.joints)} in this order",
        )
    for joint, value in zip(limits.joints, pose, strict=True):
        low, high = joint.bounds
        if not low <= value <= high:
            raise UsageError(
                f"start_pose has {joint.name} at {value:g}; allowed: {low:g} to {high:g} {joint.unit}.",
                "change start_pose, or margin_rad",
            )
    return pose


def driver_names(robot: ArmRobot, wanted: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the joints in the messages of the driver.

    Raises:
        UsageError: when there are more or fewer than joints, or one is there twice.
    """
    names = tuple(wanted) or robot.driver_names
    if len(names) != len(robot.joints) or len({*names}) < len(names):
        raise UsageError(
            f"joint_names has {len(names)} names, {len({*names})} of them different; allowed: {len(robot.joints)} "
            "different ones.",
            f"name what the driver calls {', '.join(robot.joints)}, in this order",
        )
    return names


def finite(values: Array) -> bool:
    """Return whether all numbers are finite."""
    return bool(np.isfinite(values).all())
