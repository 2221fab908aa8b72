"""What a policy of an arm sees and says: its inputs from messages, its action as positions of the robot's joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.controllers._arm_robot import ArmRobot
from vlatool.controllers._interface import Input, Snapshot
from vlatool.controllers._sensor_arrays import colours_of
from vlatool.errors import UsageError
from vlatool.messages.geometry_msgs import PoseStamped
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import String

Array = NDArray[Any]
TARGET = "target"
"""Name of the input that says where the tips are to go: (3,) or, of two arms, (6,), in metres in the world."""
MODES = ("absolute", "delta", "velocity")


class ArmPolicy(NamedTuple):
    """How the inputs and the action of a policy are those of a robot.

    Args:
        state: Input of the positions; empty where the policy has none.
        order: Places of the robot's joints in that order of the input.
        targets: Whether it has the input ``target``.
        cameras: Inputs of cameras.
        text: Input of the instruction; empty where the policy has none.
        mode: Of the action.
        places: Place of each joint of the robot in the action.
        ranges: Whether a joint is commanded by position alone in any mode.
    """

    state: str
    order: tuple[int, ...]
    targets: bool
    cameras: tuple[str, ...]
    text: str
    mode: str
    places: tuple[int, ...]
    ranges: tuple[bool, ...]

    def inputs(self, robot: ArmRobot) -> tuple[Input, ...]:
        """Return the topics that the policy needs, beside those of the joints; it acts when all of them are there."""
        targets = [
            Input(_target_of(arm), f"/{arm}/target" if arm else "/target", PoseStamped)
            for arm in (robot.chains if self.targets else ())
        ]
        cameras = [Input(name, f"/{name}/image_raw", Image) for name in self.cameras]
        texts = [Input("instruction", "/instruction", String, required=False, reliable=True, latched=True)]
        return (*targets, *cameras, *(texts if self.text else ()))

    def observation(self, snapshot: Snapshot, robot: ArmRobot, positions: Array) -> tuple[dict[str, Any] | None, str]:
        """Return what the policy sees, or None and what is missing.

        Args:
            positions: (A,) float64, measured, in the order and the units of the robot.
        """
        values: dict[str, Any] = {}
        if self.state:
            values[self.state] = positions[list(self.order)].astype(np.float32)
        if self.targets:
            target, problem = _targets(snapshot, robot)
            if target is None:
                return None, problem
            values[TARGET] = target
        for name in self.cameras:
            image, problem = colours_of(snapshot.message(name, Image))
            if image is None:
                return None, f"camera {name}: {problem}"
            values[name] = np.ascontiguousarray(image)
        if self.text:
            text = snapshot.message("instruction", String)
            if text is None:
                return None, "no instruction"
            values[self.text] = text.data
        return values, ""

    def positions(self, action: Any, commanded: Sequence[float], period_s: float) -> list[float] | None:
        """Return the positions that an action asks for, in the order of the robot; None for another shape.

        Args:
            action: (A,), as the policy returned it.
            commanded: Positions that were commanded last; differences and velocities go on from there.
            period_s: Time for which a velocity holds.
        """
        values = np.asarray(action)
        if values.shape != (len(self.places),) or values.dtype.kind != "f":
            return None
        wanted: list[float] = values.astype(np.float64)[list(self.places)].tolist()
        if self.mode == "absolute":
            return wanted
        scale = 1.0 if self.mode == "delta" else period_s
        return [
            value if alone else last + scale * value
            for value, last, alone in zip(wanted, commanded, self.ranges, strict=True)
        ]


def policy_of(spec: PolicySpec, robot: ArmRobot) -> ArmPolicy:
    """Return how the inputs and the action of a policy are those of a robot.

    Raises:
        UsageError: naming the input or the action that is not.
    """
    action = spec.action
    if action.kind == "discrete" or action.mode not in MODES:
        raise UsageError(
            f"The action '{action.name}' is {action.kind}, mode '{action.mode or 'not stated'}'; an arm takes "
            f"tensors of the modes {', '.join(MODES)}.",
            "state the mode in policy.yaml, and let 'convert' make relative actions absolute",
        )
    places = _places(action, robot)
    joints = robot.limits().joints
    ranges = tuple(joint.command == "range" for joint in joints)
    rates = [action.mode == "velocity" and not alone for alone in ranges]
    _check_units(
        action, [f"{joint.unit}/s" if rate else joint.unit for joint, rate in zip(joints, rates, strict=True)], places
    )
    order: tuple[int, ...] = ()
    cameras: list[str] = []
    state, text, targets = "", "", False
    for tensor in spec.inputs:
        if tensor.kind == "text" and not text:
            text = tensor.name
        elif tensor.name == TARGET:
            targets = _check_target(tensor, robot)
        elif tensor.image is not None or tensor.dtype == "uint8":
            cameras.append(tensor.name)
        elif tensor.labels and {*tensor.labels} == {*robot.joints} and not state:
            found = _places(tensor, robot)
            _check_units(tensor, [joint.unit for joint in joints], found)
            state, order = tensor.name, tuple(robot.joints.index(label) for label in tensor.labels)
        else:
            raise UsageError(
                f"The input '{tensor.name}' of the policy is neither a camera, a text, '{TARGET}', nor labelled by the "
                f"joints {', '.join(robot.joints)}.",
                "label it in policy.yaml, or run it with: vlatool run policy",
            )
    return ArmPolicy(state, order, targets, tuple(cameras), text, action.mode, places, ranges)


def _places(tensor: TensorSpec, robot: ArmRobot) -> tuple[int, ...]:
    """Return the place of each joint of the robot in a tensor, by its labels."""
    if len(tensor.labels) != len(robot.joints) or {*tensor.labels} != {*robot.joints}:
        raise UsageError(
            f"'{tensor.name}' has the labels {', '.join(tensor.labels) or 'none'}; {robot.name} has the joints "
            f"{', '.join(robot.joints)}.",
            "label the elements in policy.yaml by these names, in the order of the policy",
        )
    return tuple(tensor.labels.index(joint) for joint in robot.joints)


def _check_units(tensor: TensorSpec, wanted: Sequence[str], places: Sequence[int]) -> None:
    units = tensor.units()
    for unit, index in zip(wanted, places, strict=True):
        if units[index] not in ("", unit):
            raise UsageError(
                f"'{tensor.name}' has {tensor.labels[index]} in {units[index]}; the robot takes {unit}.",
                "convert it in policy.yaml",
            )


def _check_target(tensor: TensorSpec, robot: ArmRobot) -> bool:
    width = 3 * len(robot.chains)
    if tensor.robot_width != width:
        raise UsageError(
            f"'{TARGET}' has {tensor.robot_width} elements; {robot.name} takes {width}: x, y, z of each arm, in m.",
            "change the input in policy.yaml",
        )
    return True


def _target_of(arm: str) -> str:
    return f"{arm}_{TARGET}" if arm else TARGET


def _targets(snapshot: Snapshot, robot: ArmRobot) -> tuple[Array | None, str]:
    """Return where the tips are to go, float32 (3,) or (6,), or None and what is wrong."""
    places = []
    for arm in robot.chains:
        message = snapshot.message(_target_of(arm), PoseStamped)
        if message is None:
            return None, f"no {_target_of(arm)}"
        point = message.pose.position
        places += [point.x, point.y, point.z]
    target = np.array(places, np.float32)
    return (target, "") if np.isfinite(target).all() else (None, "a target that is not a place")


def observed_names(policy: ArmPolicy) -> Mapping[str, str]:
    """Return what each input of the policy is, for the record: input -> joints, target, camera, instruction."""
    names = {policy.state: "joints"} if policy.state else {}
    names |= dict.fromkeys(policy.cameras, "camera")
    return names | ({TARGET: TARGET} if policy.targets else {}) | ({policy.text: "instruction"} if policy.text else {})
