"""Forward kinematics and Jacobians of a chain of joints, in float64 and for many poses at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import cos, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import UsageError

Array = NDArray[Any]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
NO_TURN: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Link(NamedTuple):
    """A joint and the link that it moves: how its frame lies in the one before, with the joint at 0.

    Args:
        name: Of the joint.
        position: Of the frame in the one before, in metres.
        quaternion: (w, x, y, z) of the frame in the one before, of any length.
        axis: Of the joint in its own frame, of length 1; the joint turns about it.
    """

    name: str
    position: Vector
    quaternion: Quaternion = NO_TURN
    axis: Vector = (0.0, 0.0, 1.0)


class Pose(NamedTuple):
    """A fixed frame in another: metres, and a quaternion (w, x, y, z) of any length."""

    position: Vector = (0.0, 0.0, 0.0)
    quaternion: Quaternion = NO_TURN

    def matrix(self) -> Array:
        """Return it as a homogeneous matrix (4, 4)."""
        return transform(self.position, self.quaternion)


ORIGIN = Pose()


@dataclass(frozen=True)
class Chain:
    """An arm: joints that turn, one after the other, and a tip.

    Args:
        links: From the base to the tip.
        tip: The tip in the frame of the last link.
        base: The base in the world.

    Raises:
        UsageError: for a chain without joints, an axis that is not of length 1, or a name that is there twice.
    """

    links: tuple[Link, ...]
    tip: Pose = ORIGIN
    base: Pose = ORIGIN

    def __post_init__(self) -> None:
        names = [link.name for link in self.links]
        lengths = [float(np.linalg.norm(link.axis)) for link in self.links]
        if not names or len({*names}) < len(names) or any(abs(length - 1.0) > 1e-9 for length in lengths):
            raise UsageError(
                f"A chain has the joints {names}, with axes of the lengths {lengths}; allowed: one or more, each name "
                "once, axes of length 1.",
                "correct its table",
            )

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(link.name for link in self.links)

    def turns(self) -> tuple[Array, Array, Array]:
        """Return (N, 4, 4) each: a link's transform is the first, plus sine and cosine of its angle times the others.

        The base is in that of the first link.
        """
        return self._parts

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array]:
        """(N, 4, 4) each: the transform of each link is the first, plus sine and cosine of its angle times the others.

        Rodrigues' formula, with K the cross product by the axis: I + K K + sin K - cos K K.
        """
        constant, sine, cosine = (np.zeros((len(self.links), 4, 4)) for _ in range(3))
        for index, link in enumerate(self.links):
            fixed = transform(link.position, link.quaternion)
            fixed = self.base.matrix() @ fixed if not index else fixed
            cross = np.array(_cross_matrix(link.axis))
            constant[index] = fixed
            constant[index, :3, :3] = fixed[:3, :3] @ (np.eye(3) + cross @ cross)
            sine[index, :3, :3] = fixed[:3, :3] @ cross
            cosine[index, :3, :3] = -fixed[:3, :3] @ cross @ cross
        return constant, sine, cosine

    @cached_property
    def _tip(self) -> Array:
        return self.tip.matrix()

    def frames(self, positions: Any) -> Array:
        """Return the frames of all links in the world.

        Args:
            positions: (..., N) angles of the joints in rad.

        Returns:
            (..., N, 4, 4) float64.
        """
        angles = self._angles(positions)[..., None, None]
        constant, sine, cosine = self._parts
        frames: Array = constant + np.sin(angles) * sine + np.cos(angles) * cosine
        for index in range(1, len(self.links)):
            frames[..., index, :, :] = frames[..., index - 1, :, :] @ frames[..., index, :, :]
        return frames

    def tip_pose(self, positions: Any) -> Array:
        """Return the pose of the tip in the world, (..., 4, 4) float64; arguments as for ``frames``."""
        pose: Array = self.frames(positions)[..., -1, :, :] @ self._tip
        return pose

    def tip_position(self, positions: Any) -> Array:
        """Return the position of the tip in the world, (..., 3) float64 in metres; arguments as for ``frames``."""
        return self.tip_pose(positions)[..., :3, 3]

    def jacobian(self, positions: Any) -> Array:
        """Return the geometric Jacobian of the tip in the world.

        The velocity of the tip is its product with those of the joints: a column is (z x (p_tip - p), z) with z the
        axis of a joint and p its place (Siciliano et al., "Robotics: Modelling, Planning and Control", section 3.1).

        Args:
            positions: (..., N) angles of the joints in rad.

        Returns:
            (..., 6, N) float64: metres, then rad, for each rad.
        """
        frames = self.frames(positions)
        tip = (frames[..., -1, :, :] @ self._tip)[..., None, :3, 3]
        local = np.array([link.axis for link in self.links])
        axes = np.einsum("...nij,nj->...ni", frames[..., :3, :3], local)
        columns = np.concatenate([np.cross(axes, tip - frames[..., :3, 3]), axes], axis=-1)
        return np.swapaxes(columns, -1, -2)

    def _angles(self, positions: Any) -> Array:
        angles = np.asarray(positions, np.float64)
        if angles.shape[-1:] != (len(self.links),):
            raise UsageError(
                f"Positions of the shape {angles.shape} for {len(self.links)} joints; the last axis has one for each.",
                f"give {', '.join(self.joints)} in this order",
            )
        return angles


def transform(position: Sequence[float], quaternion: Sequence[float]) -> Array:
    """Return the homogeneous matrix (4, 4) of a position in metres and a quaternion (w, x, y, z) of any length."""
    w, x, y, z = np.asarray(quaternion, np.float64) / np.linalg.norm(quaternion)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = position
    return matrix


def from_modified_dh(names: Sequence[str], rows: Sequence[tuple[float, float, float]], tip: Pose = ORIGIN) -> Chain:
    """Return a chain from Denavit-Hartenberg parameters in Craig's convention.

    Args:
        names: Of the joints.
        rows: (a of the link before in m, d in m, alpha of the link before in rad) for each joint.
        tip: The tip in the frame of the last joint.
    """
    links = []
    for name, (a, d, alpha) in zip(names, rows, strict=True):
        quaternion = (cos(alpha / 2), sin(alpha / 2), 0.0, 0.0)
        links.append(Link(name, (a, -d * sin(alpha), d * cos(alpha)), quaternion))
    return Chain(tuple(links), tip)


def from_standard_dh(names: Sequence[str], rows: Sequence[tuple[float, float, float]]) -> Chain:
    """Return a chain from Denavit-Hartenberg parameters in their first convention.

    Args:
        names: Of the joints.
        rows: (a in m, d in m, alpha in rad) for each joint; the tip is the frame behind the last row.
    """
    links, before = [], ORIGIN
    for name, (a, d, alpha) in zip(names, rows, strict=True):
        links.append(Link(name, before.position, before.quaternion))
        before = Pose((a, 0.0, d), (cos(alpha / 2), sin(alpha / 2), 0.0, 0.0))
    return Chain(tuple(links), before)


def _cross_matrix(axis: Vector) -> list[list[float]]:
    x, y, z = axis
    return [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
