"""A control rate above that of the policy: each action becomes several, by interpolation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import UsageError, fix_for, suggest
from vlatool.runtime.action_elements import ActionElements, minimum_jerk
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.interface import Array, Controller, Origin, origin_of

METHODS: dict[str, Callable[[float], float]] = {"linear": float, "minimum_jerk": minimum_jerk}
"""Name -> share of the way at a share of the time."""
MODES = ("delta", "velocity", "absolute")


class InterpolatingController:
    """Acts ``factor`` times for each control step of the policy, with the observation of the first of them.

    Targets and velocities go from the last action of the policy to the new one, which is reached at the last of the
    steps; the first action of an episode is taken at once. A difference is divided among the steps. Rotations turn
    along the shortest arc where the spec says which elements are one, and the gripper gets each command at once.

    Args:
        factor: Control rate by the rate of the policy.
        method: ``linear``, or ``minimum_jerk``, with which the robot comes to rest at each action of the policy (Flash
            and Hogan 1985): for policies of a few actions a second.

    Raises:
        UsageError: when the factor is not a whole number from 1, the method is unknown, or it is not known what lies
            between two actions of this mode.
    """

    def __init__(self, controller: Controller, *, spec: PolicySpec, factor: int = 1, method: str = "linear") -> None:
        check_whole("factor", factor, 1)
        if method not in METHODS:
            raise UsageError(f"There is no method '{method}'; {suggest(method, METHODS)}.", fix_for(method, METHODS))
        action = spec.action
        if factor > 1 and (action.kind == "discrete" or action.mode not in MODES):
            mode = action.kind if action.kind == "discrete" else f"of the mode '{action.mode}'"
            raise UsageError(
                f"'{action.name}' is {mode}; what lies between two of its actions is not known. Modes that are "
                f"interpolated: {', '.join(MODES)}.",
                "write the mode of the action into the policy.yaml, or leave the interpolation out",
            )
        self.controller = controller
        self.fresh = False
        self._elements, self._factor, self._way = ActionElements(action), factor, METHODS[method]
        self._forget()

    def _forget(self) -> None:
        self._steps = 0
        self._before: Array | None = None
        self._target: Array | None = None

    @property
    def origin(self) -> Origin:
        """Where the last action came from, as the controller says it."""
        return origin_of(self.controller)

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this step of the faster control loop: (A,) float32.

        Raises:
            VlatoolError: as the controller does; the next step then asks it again.
        """
        index = self._steps % self._factor
        if index == 0 or self._target is None:
            self._before, self._target = self._target, np.asarray(self.controller.act(observation))
        self.fresh = index == 0 and self.controller.fresh
        self._steps += 1
        if self._factor == 1:
            return self._target
        return self._between(self._target, index)

    def _between(self, target: Array, index: int) -> Array:
        now, then = (self._way(each / self._factor) for each in (index, index + 1))
        if self._elements.action.mode == "delta":
            return self._elements.part(target, then - now)
        return self._elements.mix(target if self._before is None else self._before, target, then)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode, as the controller does."""
        self._forget()
        self.controller.reset(seed)
