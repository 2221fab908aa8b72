"""A return to the start pose before each episode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, UsageError
from vlatool.runtime.action_elements import ActionElements, minimum_jerk
from vlatool.runtime.arguments import check_positive
from vlatool.runtime.converter import newest_moment
from vlatool.runtime.interface import Array, Controller, Origin, origin_of

MODES = ("delta", "velocity", "absolute")
LONGEST = 2.0
"""Times the planned duration after which a robot that has not arrived is an error."""


class StartPose:
    """Moves the robot to its start pose after each reset, before the controller acts.

    The way is straight, along the shortest arc for rotations, with least jerk from rest to rest. It does not avoid
    anything: it is for a robot whose way back is free. A gripper's command is that of the pose for targets, and 0 for
    differences and velocities.

    Args:
        pose: Elements of the state, in its units; those of the first observation when None, so that the first episode
            begins where the robot stands.
        state: Name of the input with the position of each element of the action; the one with its labels when empty.
        seconds: Duration of the way.
        tolerance: Largest distance of an element from the pose at which the robot has arrived; not checked when 0.

    Raises:
        UsageError: when the pose or the state does not fit the action, or an argument is out of its range.
        SpecError: when the policy has no control rate.
    """

    def __init__(
        self, controller: Controller, *, spec: PolicySpec, pose: Sequence[float] | None = None, state: str = "",
        seconds: float = 2.0, tolerance: float = 0.0,
    ) -> None:  # fmt: skip
        check_positive("seconds", seconds, "a number of seconds")
        check_positive("tolerance", tolerance, "a number", zero=True)
        self.controller = controller
        self.fresh = False
        self._tensor, self._rate, self._tolerance = _state_of(spec, state), spec.rate, tolerance
        self._elements, self._steps = ActionElements(spec.action), math.ceil(seconds * spec.rate)
        self._pose = None if pose is None else self._checked(pose)
        self._forget(moving=True)

    def _checked(self, pose: Sequence[float]) -> Array:
        array = np.asarray(pose, np.float32)
        if array.shape != (self._tensor.robot_width,) or not np.isfinite(array).all():
            raise UsageError(
                f"The pose has the shape {list(array.shape)}; wanted: {self._tensor.robot_width} finite numbers, as "
                f"'{self._tensor.name}' has.",
                "give one position for each, in its units",
            )
        return array

    def _forget(self, *, moving: bool) -> None:
        self.moving = moving
        """Whether the next step belongs to the way to the start pose."""
        self._start: Array | None = None
        self._step = 0

    @property
    def origin(self) -> Origin:
        """Where the last action came from: the controller, or ``start_pose`` on the way."""
        return Origin("start_pose") if self.moving else origin_of(self.controller)

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this control step: on the way to the pose, or that of the controller.

        Raises:
            DataError: when the observation has no finite position, or the robot does not arrive.
            VlatoolError: as the controller does.
        """
        action = self._way(observation) if self.moving else None
        if action is not None:
            self.fresh = False
            return action
        self.moving = False
        answer, self.fresh = self.controller.act(observation), self.controller.fresh
        return answer

    def _way(self, observation: Mapping[str, Any]) -> Array | None:
        """Return the next action on the way; None when the robot is there."""
        here = self._position(observation)
        if self._pose is None:
            self._pose = here
            return None
        if self._start is None:
            self._start = here
        if self._step >= self._steps and self._arrived(here, self._pose):
            return None
        before, after = (self._at(self._start, self._pose, step) for step in (self._step, self._step + 1))
        self._step += 1
        return self._command(before, after)

    def _position(self, observation: Mapping[str, Any]) -> Array:
        name = self._tensor.name
        if name not in observation:
            raise DataError(f"The observation has no '{name}', which says where the robot stands.", f"give it '{name}'")
        here = newest_moment(observation[name], self._tensor.robot_width)
        if not np.isfinite(here).all():
            raise DataError(f"The position '{name}' is not finite.", "see what measures it; the robot does not move")
        return here

    def _arrived(self, here: Array, pose: Array) -> bool:
        distance = float(np.abs(here - pose).max())
        if self._tolerance and distance > self._tolerance and self._step > LONGEST * self._steps:
            raise DataError(
                f"The robot is {distance:.3g} away from its start pose after {LONGEST:g} times the planned duration; "
                f"allowed: {self._tolerance:g}.",
                "see what holds it, or raise the tolerance or the duration",
            )
        return not self._tolerance or distance <= self._tolerance

    def _at(self, start: Array, pose: Array, step: int) -> Array:
        share = minimum_jerk(min(1.0, step / self._steps))
        return self._elements.mix_rotations(start + (pose - start) * np.float32(share), start, pose, share)

    def _command(self, before: Array, after: Array) -> Array:
        mode = self._elements.action.mode
        if mode == "absolute":
            return after
        step = self._elements.difference(before, after)
        if (gripper := self._elements.action.gripper) is not None:
            step[gripper] = 0
        return step if mode == "delta" else np.asarray(step * np.float32(self._rate))

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode, which begins with the way to the start pose."""
        self._forget(moving=True)
        self.controller.reset(seed)


def _state_of(spec: PolicySpec, name: str) -> TensorSpec:
    """Return the input that says where each element of the action stands.

    Raises:
        UsageError: when there is none, or several, or the way in which the action moves the robot is unknown.
    """
    action = spec.action
    if action.kind == "discrete" or action.mode not in MODES:
        what = action.kind if action.kind == "discrete" else f"of the mode '{action.mode}'"
        raise UsageError(f"'{action.name}' is {what}; wanted: one of the modes {', '.join(MODES)}.",
                         "leave start_pose out")  # fmt: skip
    vectors = [
        tensor for tensor in spec.inputs
        if tensor.kind == "tensor" and tensor.robot_width == action.robot_width and len(tensor.moment.shape) == 2
        and (tensor.name == name or (not name and tensor.labels == action.labels))
    ]  # fmt: skip
    if len(vectors) != 1:
        raise UsageError(
            f"{len(vectors)} inputs have the {action.robot_width} elements of '{action.name}'"
            f"{f' and the name {name!r}' if name else ''}; wanted: one, with the position of each.",
            "name it: start_pose:state=NAME",
        )
    _check_units(vectors[0], action)
    return vectors[0]


def _check_units(state: TensorSpec, action: TensorSpec) -> None:
    """Refuse a state in other units than the action moves it in, as far as both are stated; raises UsageError."""
    per_second = "/s" if action.mode == "velocity" else ""
    for index, (position, move) in enumerate(zip(state.units(), action.units(), strict=True)):
        commanded = index != action.gripper or action.mode == "absolute"
        if position and move and commanded and move != position + per_second:
            raise UsageError(
                f"Element {index} of '{state.name}' is in {position}, that of '{action.name}' in {move}; wanted: "
                f"{position}{per_second}.",
                "convert one of them in policy.yaml, or leave start_pose out",
            )
