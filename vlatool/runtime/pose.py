"""Poses that are relative to others: a rotation, or a position and a rotation, composed with that of a state."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.conversion import ROTATIONS
from vlatool.runtime.rotation import convert_rotation, inverse, product, to_quaternions, turn

Array = NDArray[Any]


class Pose(NamedTuple):
    """Positions (..., 3), or (..., 0) of rotations alone, and unit quaternions (..., 4), float64."""

    positions: Array
    quaternions: Array

    def moved_by(self, difference: Pose, frame: str) -> Pose:
        """Return these poses after a difference in the frame of the ``tool``, or in that of the ``base``."""
        if frame == "base":
            quaternions, more = product(difference.quaternions, self.quaternions), difference.positions
        else:
            quaternions = product(self.quaternions, difference.quaternions)
            more = _turned(difference.positions, self.quaternions)
        return Pose(self.positions + more, quaternions)

    def difference_to(self, other: Pose, frame: str) -> Pose:
        """Return the difference after which these poses are others; the counterpart of ``moved_by``."""
        back, way = inverse(self.quaternions), other.positions - self.positions
        if frame == "base":
            return Pose(way, product(other.quaternions, back))
        return Pose(_turned(way, back), product(back, other.quaternions))


def absolute_poses(differences: Array, state: Array, form: str, frame: str, *, successive: bool) -> Array:
    """Return poses of which differences from a state are given, each from the one before it where they are successive.

    Args:
        differences: (T, W) rotations in a form, after three elements of a position if W has those.
        state: (W,).
    """
    relative, start = _pose(differences, form), _pose(state, form)
    if not successive:
        return _values(start.moved_by(relative, frame), form, differences.dtype)
    reached = []
    for difference in map(Pose, *relative):
        start = start.moved_by(difference, frame)
        reached.append(start)
    return _values(Pose(*map(np.stack, zip(*reached, strict=True))), form, differences.dtype)


def relative_poses(poses: Array, state: Array, form: str, frame: str, *, successive: bool) -> Array:
    """Return the differences that lead to poses (T, W); the counterpart of ``absolute_poses``."""
    goals, start = _pose(poses, form), _pose(state, form)
    if successive:
        start = Pose(*(np.concatenate([first[None], rest[:-1]]) for first, rest in zip(start, goals, strict=True)))
    return _values(start.difference_to(goals, frame), form, poses.dtype)


def _turned(positions: Array, quaternions: Array) -> Array:
    return turn(positions, quaternions) if positions.shape[-1] else positions


def _pose(values: Array, form: str) -> Pose:
    wide, width = np.asarray(values, np.float64), ROTATIONS[form]
    return Pose(wide[..., :-width], to_quaternions(wide[..., -width:], form))


def _values(pose: Pose, form: str, dtype: Any) -> Array:
    rotations = convert_rotation(pose.quaternions, "quaternion_xyzw", form)
    return np.concatenate([pose.positions, rotations], axis=-1).astype(dtype)
