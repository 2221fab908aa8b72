"""Rungs of a fallback ladder: each answers a control step, or raises, so that the one below it does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DeadlineMissed, UsageError
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.control.late import hold
from vlatool.runtime.interface import CHUNK, HOLD, STOP, Array, Controller, Origin, origin_of

DECELERATE = "decelerate"
"""Source of the actions of a robot that slows down to a stop."""
NO_MOTION = frozenset({"stop", "noop", "no-op", "no op", "none", "stay", "idle", "wait", "hold"})
"""Labels of discrete actions without motion."""


class Rung:
    """One way to answer a control step.

    Args:
        source: What its actions say that they come from.
    """

    bridges = False
    """Whether it only bridges steps without an answer of the rung above, so that the ladder never stays on it."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.origin = Origin(source)

    def act(self, observation: Mapping[str, Any], last: Array | None) -> Array:
        """Return the action of this step, (A,) or a 0-d index.

        Args:
            last: The action of the step before; None at the first.

        Raises:
            Exception: when it has none.
        """
        raise NotImplementedError

    def pause(self) -> None:
        """Expect to be asked next after steps at which another rung answered."""

    def watch(self, observation: Mapping[str, Any]) -> None:
        """See the observation of a step at which it is not asked."""

    def reset(self, seed: int | None) -> None:
        """Start a new episode."""
        self.pause()


class PolicyRung(Rung):
    """A controller that plays a policy: the first one, or another.

    Args:
        source: Empty for the first policy, whose actions keep the source that they have.
    """

    def __init__(self, controller: Controller, source: str = "") -> None:
        super().__init__(source)
        self.controller = controller

    def act(self, observation: Mapping[str, Any], last: Array | None) -> Array:
        """Return the controller's action; raises what it raises."""
        action = self.controller.act(observation)
        origin = origin_of(self.controller)
        self.origin = origin._replace(source=self.source) if self.source else origin
        return action

    def pause(self) -> None:
        """Discard pending actions: they answer old observations."""
        if hasattr(self.controller, "drop"):
            self.controller.drop()

    def watch(self, observation: Mapping[str, Any]) -> None:
        """Pass the observation on to a policy whose inputs hold several moments."""
        if hasattr(self.controller, "observe"):
            self.controller.observe(observation)

    def reset(self, seed: int | None) -> None:
        """Start a new episode of the controller."""
        self.controller.reset(seed)


class ChunkRung(Rung):
    """The rest of the chunk that was played last.

    Args:
        player: A controller with ``rest()``, such as ``ChunkQueue``.
        max_age_ms: Age in milliseconds above which an action is not used.
    """

    bridges = True

    def __init__(self, player: Any, max_age_ms: float | None = None) -> None:
        super().__init__(CHUNK)
        self._player, self._max_age_ms = player, max_age_ms

    def act(self, observation: Mapping[str, Any], last: Array | None) -> Array:
        """Return the next action of the rest; raises DeadlineMissed when it is used up or too old."""
        action = self._player.rest()
        if action is None:
            raise DeadlineMissed("The last chunk is used up.")
        self.origin = origin_of(self._player)
        age = self.origin.age_ms
        if self._max_age_ms is not None and age is not None and age > self._max_age_ms:
            raise DeadlineMissed(f"The last chunk is {age:.0f} ms old; allowed: {self._max_age_ms:g} ms.")
        return np.asarray(action)


class Hold(Rung):
    """No motion for a while: a position is held, a velocity and a delta are 0, the gripper keeps its command.

    A velocity is not cut off but falls linearly to 0 within ``ramp`` steps.

    Args:
        action: Spec of the action.
        steps: Number of control steps in a row that it answers; any number when None.
        ramp: Number of control steps in which a velocity falls to 0.
        neutral: Label of a discrete action without motion; one of ``NO_MOTION`` when empty.

    Raises:
        UsageError: when a number is out of its range, or a label is given and no label is the one without motion.
    """

    def __init__(
        self,
        action: TensorSpec,
        steps: int | None = None,
        *,
        ramp: int = 1,
        neutral: str = "",
        source: str = "",
    ) -> None:
        check_whole("steps", steps, 0, optional=True)
        check_whole("ramp", ramp, 1)
        slows = action.mode == "velocity" and ramp > 1
        super().__init__(source or (DECELERATE if slows else HOLD))
        self._action, self._limit, self._ramp = action, steps, ramp
        self._first: Array | None = None
        self._left_to_envelope = False
        self._index = neutral_index(action, neutral) if action.kind == "discrete" or neutral else None
        self.pause()

    def act(self, observation: Mapping[str, Any], last: Array | None) -> Array:
        """Return the next action without, or towards no, motion; raises DeadlineMissed after the last of its steps."""
        if self._left_to_envelope:
            raise DeadlineMissed("The envelope around the ladder stops the robot.")
        if self._limit is not None and self._done >= self._limit:
            raise DeadlineMissed(f"The robot has held for {self._limit} control steps.")
        if not self._done:
            self._first = last
        action = self._next(last)
        self._done += 1
        return action

    def _next(self, last: Array | None) -> Array:
        if self._index is not None:
            return np.asarray(self._index)
        if last is None:
            return self._without_motion()
        if self._action.mode != "velocity" or self._first is None:
            return hold(self._action, last)
        share = max(0.0, 1 - (self._done + 1) / self._ramp)
        slower = np.asarray(self._first * share, self._first.dtype)
        if (gripper := self._action.gripper) is not None:
            slower[gripper] = last[gripper]
        return slower

    def _without_motion(self) -> Array:
        """Return the action that means no motion, where there was none before."""
        if self._action.mode not in ("delta", "velocity") or self._action.robot_width < 1:
            raise DeadlineMissed("There is no action yet that could be held.", "give the pose to hold: start=[...]")
        return hold(self._action, np.zeros(self._action.robot_width, np.float32))

    def leave_to_envelope(self) -> None:
        """Have no action from now on: the envelope around the ladder stops the robot as it has proven that it can."""
        self._left_to_envelope = True

    def pause(self) -> None:
        """Begin anew when it is asked next."""
        self._done = 0
        self._first = None


class Stop(Hold):
    """The same without an end, as the last rung."""

    def __init__(self, action: TensorSpec, *, ramp: int = 1, neutral: str = "") -> None:
        super().__init__(action, ramp=ramp, neutral=neutral, source=STOP)


def start_pose(pose: Any, action: TensorSpec) -> Array:
    """Return the pose that is held before the first action: (A,) float32.

    Raises:
        UsageError: when it is not one finite number for each element of the action.
    """
    try:
        array = np.asarray(pose, np.float32)
    except (TypeError, ValueError):
        array = np.asarray(np.nan)
    if array.shape != (action.robot_width,) or not np.isfinite(array).all():
        raise UsageError(
            f"The start is {pose!r:.80}; allowed: {action.robot_width} finite numbers, one for each element of "
            f"'{action.name}'.",
            "pass start=[...] with the pose of the robot",
        )
    return array


def neutral_index(action: TensorSpec, label: str = "") -> int:
    """Return the index of the discrete action without motion: that of a label, or of the only one in ``NO_MOTION``.

    Raises:
        UsageError: when the action is not discrete, the label is not there, or none or several of the labels mean no
            motion.
    """
    if action.kind != "discrete":
        raise UsageError(
            f"neutral is {label!r}, and the action '{action.name}' is not discrete: it has no label without motion.",
            "leave neutral out",
        )
    found = [index for index, name in enumerate(action.labels)
             if (name == label if label else name.lower() in NO_MOTION)]  # fmt: skip
    if len(found) != 1:
        known = ", ".join(action.labels[:20])
        raise UsageError(
            f"{len(found)} of the labels of '{action.name}' are {label or 'known to mean no motion'}; labels: {known}.",
            "name the one without motion: Fallback(neutral=LABEL), or --neutral LABEL",
        )
    return found[0]
