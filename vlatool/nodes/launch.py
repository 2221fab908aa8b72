"""What a run is made of: the controller by its name, with its settings and its policy, whose deadline is on."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec
from vlatool.controllers import RobotController, with_policy
from vlatool.errors import UsageError
from vlatool.machine.version import VERSION
from vlatool.nodes.settings import build, to_plain
from vlatool.nodes.step_record import ControllerRecord
from vlatool.runtime import load
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.envelope.limits import RobotLimits, robot_names
from vlatool.runtime.interface import layers_of
from vlatool.runtime.rungs import NO_MOTION
from vlatool.runtime.stack import Fallback

DEADLINE_SHARE = 0.8
"""Part of a controller's period in which its policy answers; the rest is for sensors, checks and sending."""


@dataclass(frozen=True)
class PolicyOptions:
    """How the policy of a controller is opened.

    Args:
        bundle: The bundle; None for a controller without one.
        robot: Robot whose limits no action leaves; empty for none. A controller with limits of its own
            (``limits_of``) keeps them, and takes no other robot.
        deadline_ms: Time in which a step has its action; ``DEADLINE_SHARE`` of the period when None; 0 for none, as in
            a simulation, whose clock is not that of the processor.
        neutral: Label of the discrete action without motion.
        engine: Engine; the bundle's when empty.
        threads: Threads; all cores when None.
        seed: Seed of the policy's noise.
    """

    bundle: Path | None = None
    robot: str = ""
    deadline_ms: float | None = None
    neutral: str = ""
    engine: str = ""
    threads: int | None = None
    seed: int | None = None


def needs_policy(controller: type) -> bool:
    """Return whether a class of controllers takes a policy."""
    return any(field.name == "policy" for field in dataclasses.fields(controller))


def robot_name(name: str) -> str:
    """Return the name of a robot in the tables: ``turtlebot4`` is ``turtlebot-4``, too; others as they are."""
    plain = {known.replace("-", ""): known for known in robot_names()}
    return plain.get(name.replace("-", "").replace("_", "").lower(), name)


def open_controller(name: str, settings: Mapping[str, Any], options: PolicyOptions) -> RobotController[Any]:
    """Return a controller that can run.

    Args:
        name: Name of the controller.
        settings: Its settings, as JSON has them.
        options: Its policy.

    Raises:
        UsageError: for an unknown controller or setting, and for a bundle that is missing or not wanted.
        BundleError, SpecError, GraphError, MissingExtra: as ``vlatool.runtime.load`` does.
    """
    entry = registry.load("controllers", name)
    controller = build(entry, settings, f"vlatool run {name.replace('_', '-')}")
    if not needs_policy(entry):
        if options.bundle is not None:
            raise UsageError(f"The controller '{name}' takes no policy, and there is --bundle {options.bundle}.",
                             "leave --bundle out")  # fmt: skip
        return controller  # type: ignore[no-any-return]
    if options.bundle is None:
        raise UsageError(f"The controller '{name}' needs a policy.", "pass --bundle BUNDLE")
    return with_policy(controller, open_policy(options, controller))  # type: ignore[no-any-return]


def open_policy(options: PolicyOptions, controller: Any) -> Any:
    """Return the policy of a controller with its layers: the deadline, the fallback, the envelope of the robot.

    A policy with discrete actions of which none is without motion has no fallback but its controller, which lets the
    robot stand: it is a policy with a deadline then, not a stack.

    Args:
        controller: The controller without a policy, for its rate.
    """
    if options.bundle is None:
        raise TypeError("a policy is opened from a bundle")
    spec = Bundle.open(options.bundle).manifest.spec
    limit_ms = deadline_of(options.deadline_ms, controller, spec)
    robot = _robot_of(options, controller)
    opening: dict[str, Any] = {"engine": options.engine, "threads": options.threads, "seed": options.seed}
    if spec.action.kind == "discrete" and not (options.neutral or {*spec.action.labels} & {*NO_MOTION}):
        policy = load(options.bundle, **opening)
        return policy if limit_ms is None else Deadline(policy, limit_ms)
    return load(
        options.bundle,
        **opening,
        controllers=(),
        envelope=robot if robot and spec.action.kind != "discrete" else None,
        deadline_ms=limit_ms,
        fallback=Fallback(neutral=options.neutral) if limit_ms is not None else None,
    )


def _robot_of(options: PolicyOptions, controller: Any) -> str:
    """Return the robot whose limits the policy's actions are to keep; empty where the controller keeps them itself.

    A second envelope would know nothing of what the controller does between two actions, such as a way to a start pose.
    """
    robot, kept = robot_name(options.robot), getattr(controller, "limits_of", "")
    if robot:
        RobotLimits.named(robot)
    if robot and kept and robot != kept:
        raise UsageError(f"The controller keeps the limits of {kept}, and --robot is {robot}.",
                         f"leave --robot out, or name {kept}")  # fmt: skip
    return "" if kept else robot


def deadline_of(deadline_ms: float | None, controller: Any, spec: PolicySpec) -> float | None:
    """Return the deadline of a policy in milliseconds, None without one: within its own period, too."""
    if deadline_ms is not None:
        return deadline_ms or None
    periods = [1000 / spec.control_hz] if spec.control_hz else []
    if (rate := _rate(controller)) is not None:
        periods.append(DEADLINE_SHARE * 1000 / rate)
    return min(periods, default=None)


def _rate(controller: Any) -> float | None:
    """Return the rate of a controller in Hz; None where that is its policy's."""
    try:
        rate = controller.rate_hz
    except (AttributeError, UsageError):
        return None
    return float(rate) if rate else None


def identity_of(policy: Any) -> str:
    """Return the identity of the bundle inside the layers of a policy; empty without one."""
    layers = [] if policy is None else getattr(policy, "layers", None) or layers_of(policy)
    return next((str(layer.identity) for layer in reversed(layers) if hasattr(layer, "identity")), "")


def record_of(
    name: str, controller: Any, node: str, topics: Mapping[str, str], options: PolicyOptions
) -> ControllerRecord:
    """Return the record of what runs."""
    policy = identity_of(getattr(controller, "policy", None))
    return ControllerRecord(name, to_plain(controller), dict(topics), node, policy, robot_name(options.robot), VERSION)
