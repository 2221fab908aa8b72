"""How near two arms are to each other: the least distance of capsules around their links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.kinematics.chain import Chain, Vector

Array = NDArray[Any]


class Capsule(NamedTuple):
    """A body around a link: all that is within a radius of a segment in the frame of the link.

    Args:
        link: Index of the link in its chain; -1 for what stands around the base.
        begin, end: Of the segment, in metres.
        radius: In metres.
    """

    link: int
    begin: Vector
    end: Vector
    radius: float


@dataclass(frozen=True)
class Clearance:
    """The least distance between two arms in a vector of joint positions.

    Args:
        chains: Of both arms, with their bases in one world.
        joints: Places of the joints of each arm in the vector.
        capsules: Around the links of each arm.
    """

    chains: tuple[Chain, Chain]
    joints: tuple[Sequence[int], Sequence[int]]
    capsules: tuple[Sequence[Capsule], Sequence[Capsule]]

    def __call__(self, positions: Any) -> Array:
        """Return the least distance in metres, negative where capsules overlap.

        Args:
            positions: (..., A) float64, in rad.

        Returns:
            (...) float64.
        """
        values = np.asarray(positions, np.float64)
        both = self._both
        begin, end = both.segments(both.frames(values[..., both.joints]))
        distances = segment_distances(
            begin[..., 0, :, None, :], end[..., 0, :, None, :], begin[..., 1, None, :, :], end[..., 1, None, :, :]
        )
        nearest: Array = (distances - both.radii[0, :, None] - both.radii[1]).min(axis=(-2, -1))
        return nearest

    @cached_property
    def _both(self) -> _Both:
        return _Both.of(self.chains, self.joints, self.capsules)


class _Both(NamedTuple):
    """Two arms as one array, for half of the calls: the shorter one has links that turn nothing, and capsules again.

    Args:
        joints: (2, N) places of the joints in the vector.
        constant, sine, cosine: (2, N, 4, 4), as in ``Chain``.
        base: (2, 4, 4) in the world.
        arms, links: (2, 1) and (2, C) index of the frame of each capsule; the last frame of an arm is its base.
        begin, end: (2, C, 3, 1) in those frames.
        radii: (2, C).
    """

    joints: Array
    constant: Array
    sine: Array
    cosine: Array
    base: Array
    arms: Array
    links: Array
    begin: Array
    end: Array
    radii: Array

    @classmethod
    def of(
        cls, chains: Sequence[Chain], joints: Sequence[Sequence[int]], capsules: Sequence[Sequence[Capsule]]
    ) -> _Both:
        """Return those of two arms."""
        count = max(len(chain.links) for chain in chains)
        parts = np.zeros((3, 2, count, 4, 4))
        parts[0] = np.eye(4)
        for arm, chain in enumerate(chains):
            parts[:, arm, : len(chain.links)] = chain.turns()
        width = max(map(len, capsules))
        own = [[*each, *[each[0]] * (width - len(each))] for each in capsules]
        begin, end = (np.array([[getattr(one, side) for one in each] for each in own])[..., None]
                      for side in ("begin", "end"))  # fmt: skip
        return cls(
            np.array([[*places, *[places[-1]] * (count - len(places))] for places in joints]),
            parts[0],
            parts[1],
            parts[2],
            np.array([chain.base.matrix() for chain in chains]),
            np.array([[0], [1]]),
            np.array([[count if one.link < 0 else one.link for one in each] for each in own]),
            begin,
            end,
            np.array([[one.radius for one in each] for each in own]),
        )

    def frames(self, angles: Array) -> Array:
        """Return the frames of all links and of the bases in the world, (..., 2, N + 1, 4, 4), for angles (..., 2, N).

        As ``Chain.frames`` computes them, bit for bit.
        """
        turned = angles[..., None, None]
        count = angles.shape[-1]
        frames = np.empty((*angles.shape[:-1], count + 1, 4, 4))
        frames[..., :count, :, :] = self.constant + np.sin(turned) * self.sine + np.cos(turned) * self.cosine
        for index in range(1, count):
            frames[..., index, :, :] = frames[..., index - 1, :, :] @ frames[..., index, :, :]
        frames[..., count, :, :] = self.base
        return frames

    def segments(self, frames: Array) -> tuple[Array, Array]:
        """Return begin and end of each capsule's segment in the world, (..., 2, C, 3) each."""
        own = frames[..., self.arms, self.links, :, :]
        origins, rotations = own[..., :3, 3], own[..., :3, :3]
        return origins + (rotations @ self.begin)[..., 0], origins + (rotations @ self.end)[..., 0]


def segment_distances(one_begin: Array, one_end: Array, two_begin: Array, two_end: Array) -> Array:
    """Return the least distances of segments in metres (Ericson, "Real-Time Collision Detection", section 5.1.9).

    Args:
        one_begin, one_end, two_begin, two_end: (..., 3), broadcast against each other; segments may be points.

    Returns:
        (...) float64.
    """
    d1, d2, r = one_end - one_begin, two_end - two_begin, one_begin - two_begin
    a, e, f = (_dot(x, y) for x, y in ((d1, d1), (d2, d2), (d2, r)))
    b, c = _dot(d1, d2), _dot(d1, r)
    denominator = a * e - b * b
    parallel = denominator <= 1e-12 * np.maximum(a * e, 1e-300)
    s = np.where(parallel, 0.0, np.clip((b * f - c * e) / np.where(parallel, 1.0, denominator), 0.0, 1.0))
    long, wide = e > 0.0, a > 0.0
    t = np.where(long, (b * s + f) / np.where(long, e, 1.0), 0.0)
    outside = (t < 0.0) | (t > 1.0) | ~long
    t = np.clip(t, 0.0, 1.0)
    again = np.where(wide, np.clip((b * t - c) / np.where(wide, a, 1.0), 0.0, 1.0), 0.0)
    s = np.where(outside, again, s)
    gap = r + s[..., None] * d1 - t[..., None] * d2
    distances: Array = np.sqrt(_dot(gap, gap))
    return distances


def _dot(one: Array, two: Array) -> Array:
    product: Array = np.einsum("...i,...i->...", one, two)
    return product
