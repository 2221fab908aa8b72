"""The envelope for the actions of a policy: its mode, width, names, units and rate are those of the spec."""

from __future__ import annotations

from typing import Any

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import UsageError
from vlatool.runtime.envelope.envelope import MODES, Envelope
from vlatool.runtime.envelope.limits import JointLimits, RobotLimits


def envelope_of(spec: PolicySpec, limits: RobotLimits, *, period_s: float | None = None, **options: Any) -> Envelope:
    """Return the envelope of a robot for the actions of a policy.

    If the labels of the action are names of the robot's joints, the limits are put into their order.

    Args:
        spec: of the policy.
        limits: of the robot.
        period_s: nominal time between two actions; that of the spec's ``control_hz`` when None.
        options: further arguments of ``Envelope``.

    Raises:
        UsageError: when the action is discrete, of an unknown mode or rate, or has another width or unit.
    """
    action = spec.action
    if action.kind == "discrete" or action.mode not in MODES:
        raise UsageError(
            f"The action '{action.name}' is {action.kind}, mode '{action.mode or 'not stated'}'; an envelope bounds "
            f"tensors of the modes {', '.join(MODES)}.",
            "state the mode of the action in policy.yaml, and let 'convert' make relative actions absolute",
        )
    if period_s is None and spec.control_hz is None:
        raise UsageError("Nobody said at which rate the policy acts.", "pass period_s, or write control_hz in its spec")
    limits = _in_order(action, limits)
    for joint, unit in zip(limits.joints, action.units(), strict=True):
        _check_unit(joint, unit, action.mode)
    period = period_s if period_s is not None else 1 / (spec.control_hz or 1)
    return Envelope(limits, period, mode=action.mode, **options)


def check_position(tensor: TensorSpec, limits: RobotLimits) -> None:
    """Refuse an input that measures where the robot is in another unit than its limits, which are in its order.

    Raises:
        UsageError: naming the joint and both units.
    """
    for joint, unit in zip(limits.joints, tensor.units(), strict=True):
        if unit not in ("", joint.unit):
            raise UsageError(
                f"'{tensor.name}' measures {joint.name} in {unit}; its limits are in {joint.unit}.",
                "convert the input in policy.yaml, or the limits: limits.in_degrees() for degrees",
            )


def _in_order(action: TensorSpec, limits: RobotLimits) -> RobotLimits:
    names = {joint.name for joint in limits.joints}
    if action.labels and names.issuperset(action.labels):
        limits = limits.in_order(action.labels)
    if len(limits.joints) != action.robot_width:
        raise UsageError(
            f"The action '{action.name}' has {action.robot_width} elements; '{limits.name}' has {len(limits.joints)} "
            f"joints: {', '.join(joint.name for joint in limits.joints)}.",
            "label the elements by joints, add joints with limits.plus(...), or name the limits of another robot",
        )
    return limits


def _check_unit(joint: JointLimits, unit: str, mode: str) -> None:
    """Refuse a unit that is stated and is not the one of the limits."""
    rate = joint.command != "range" and "velocity" in (joint.command, mode)
    wanted = f"{joint.unit}/s" if rate else joint.unit
    if unit not in ("", wanted):
        raise UsageError(
            f"The action gives {joint.name} in {unit}; its limits are in {wanted}.",
            "convert the action in policy.yaml, or the limits: limits.in_degrees() for degrees",
        )
