"""Arithmetic on single actions, element by element as the spec means them: rotations, a gripper, differences."""

from __future__ import annotations

import numpy as np

from vlatool.bundle.conversion import ROTATIONS, Span
from vlatool.bundle.spec import TensorSpec
from vlatool.runtime.interface import Array
from vlatool.runtime.rotation import convert_rotation, inverse, product, slerp, to_quaternions

QUATERNION = "quaternion_xyzw"
STOPPABLE_MODES = ("delta", "velocity")
"""Action modes that can express no motion: zeros, and for a rotation the identity."""
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


class ActionElements:
    """What an action can be scaled to, and what lies between two of them.

    Elements that the spec calls a rotation (the parts of a step ``rotation``, the rotation of a ``pose``) turn along
    the shortest arc, the gripper jumps from one command to the next, and all others are computed as numbers.
    """

    def __init__(self, action: TensorSpec) -> None:
        self.action = action
        self.rotations = rotations_of(action)
        self._gripper = action.gripper

    def mix(self, before: Array, after: Array, share: float) -> Array:
        """Return what lies at a share of the way, (A,): ``before`` at 0, ``after`` at 1.

        On the way, the gripper has the command of ``after``.
        """
        if share in (0, 1):
            return (after if share else before).copy()
        mixed = np.asarray(before + (after - before) * np.float32(share), after.dtype)
        mixed = self.mix_rotations(mixed, before, after, share)
        if self._gripper is not None:
            mixed[self._gripper] = after[self._gripper]
        return mixed

    def mix_rotations(self, mixed: Array, before: Array, after: Array, share: float | Array) -> Array:
        """Return ``mixed``, (..., A), changed in place: its rotations are at a share, (...), of the way between two."""
        for (start, stop), form in self.rotations:
            one, other = (to_quaternions(each[..., start:stop], form) for each in (before, after))
            turned = slerp(one, other, np.asarray(share)[..., None])
            mixed[..., start:stop] = convert_rotation(turned, QUATERNION, form)
        return mixed

    def part(self, difference: Array, share: float) -> Array:
        """Return a share of a difference or a velocity, (A,); the gripper keeps its command."""
        if share == 1:
            return difference.copy()
        part = np.asarray(difference * np.float32(share), difference.dtype)
        for (start, stop), form in self.rotations:
            turned = slerp(IDENTITY, to_quaternions(difference[start:stop], form), share)
            part[start:stop] = convert_rotation(turned, QUATERNION, form)
        if self._gripper is not None:
            part[self._gripper] = difference[self._gripper]
        return part

    def add(self, first: Array, second: Array) -> Array:
        """Return one difference for two, (A,), the second after the first; the gripper's command is the second's."""
        total = np.asarray(first + second, second.dtype)
        for (start, stop), form in self.rotations:
            turns = (to_quaternions(each[start:stop], form) for each in (second, first))
            total[start:stop] = convert_rotation(product(*turns), QUATERNION, form)
        if self._gripper is not None:
            total[self._gripper] = second[self._gripper]
        return total

    def shift(self, action: Array, before: Array, after: Array) -> Array:
        """Return an action changed by the difference of two others, (A,); the gripper keeps its command."""
        moved = np.asarray(action + (after - before), action.dtype)
        for (start, stop), form in self.rotations:
            own, one, other = (to_quaternions(each[start:stop], form) for each in (action, before, after))
            turned = product(product(other, inverse(one)), own)
            moved[start:stop] = convert_rotation(turned, QUATERNION, form)
        if self._gripper is not None:
            moved[self._gripper] = action[self._gripper]
        return moved

    def difference(self, before: Array, after: Array) -> Array:
        """Return the difference that leads from one place to another, (A,)."""
        step = np.asarray(after - before)
        for (start, stop), form in self.rotations:
            one, other = (to_quaternions(each[start:stop], form) for each in (before, after))
            step[start:stop] = convert_rotation(product(other, inverse(one)), QUATERNION, form)
        return step

    def hold(self, last: Array) -> Array:
        """Return the action of a robot that gets no new one: no motion if the mode has that, else the last action."""
        if self.action.kind == "discrete" or self.action.mode not in STOPPABLE_MODES:
            return last.copy()
        still = np.zeros_like(last)
        for (start, stop), form in self.rotations:
            still[start:stop] = convert_rotation(IDENTITY, QUATERNION, form)
        if self._gripper is not None:
            still[self._gripper] = last[self._gripper]
        return still


def rotations_of(action: TensorSpec) -> tuple[tuple[Span, str], ...]:
    """Return the rotations in an action, as the robot gets it: places, and form (of ``ROTATIONS``).

    They are those of the steps ``rotation`` and ``relative`` with a ``pose`` in ``convert``. Behind a step that changes
    the number of elements, places are no longer those of the robot, and such steps are left out.
    """
    found: dict[Span, str] = {}
    for step, layout in zip(action.convert, action.layouts(), strict=False):
        form = str(step.robot) if step.op == "rotation" else step.pose
        if form:
            spans = layout.spans(step.parts, step.where)
            found.update({(stop - ROTATIONS[form], stop): form for _, stop in spans})
        if step.growth:
            break
    return tuple(found.items())


def minimum_jerk(share: float) -> float:
    """Return the share of the way at a share of the time, 0 to 1, with least jerk from rest to rest.

    It is 10 t^3 - 15 t^4 + 6 t^5 (Flash and Hogan 1985, "The coordination of arm movements").
    """
    return share**3 * (10 - 15 * share + 6 * share**2)
