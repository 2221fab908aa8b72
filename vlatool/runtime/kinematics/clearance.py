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
        ends = [_segments(chain, values[..., body.joints], body)
                for chain, body in zip(self.chains, self._bodies, strict=True)]  # fmt: skip
        (one_begin, one_end), (two_begin, two_end) = ends
        distances = segment_distances(
            one_begin[..., :, None, :], one_end[..., :, None, :], two_begin[..., None, :, :], two_end[..., None, :, :]
        )
        one, two = self._bodies
        nearest: Array = (distances - one.radii[:, None] - two.radii[None, :]).min(axis=(-2, -1))
        return nearest

    @cached_property
    def _bodies(self) -> tuple[_Body, _Body]:
        """Both arms as arrays."""
        parts = zip(self.chains, self.joints, self.capsules, strict=True)
        one, two = (_Body.of(chain, joints, capsules) for chain, joints, capsules in parts)
        return one, two


class _Body(NamedTuple):
    """Capsules of an arm as arrays, so that a distance makes no array of them.

    Args:
        joints: Places of its joints in the vector.
        links: (C,) index of the frame of each capsule; the last frame is the base.
        begin, end: (C, 3, 1) in those frames.
        radii: (C,).
        base: (1, 4, 4) in the world.
    """

    joints: list[int]
    links: list[int]
    begin: Array
    end: Array
    radii: Array
    base: Array

    @classmethod
    def of(cls, chain: Chain, joints: Sequence[int], capsules: Sequence[Capsule]) -> _Body:
        """Return those of an arm."""
        links = [capsule.link for capsule in capsules]
        begin, end = (np.array([getattr(each, side) for each in capsules])[..., None] for side in ("begin", "end"))
        radii = np.array([capsule.radius for capsule in capsules])
        return cls(list(joints), links, begin, end, radii, chain.base.matrix()[None])


def _segments(chain: Chain, positions: Array, body: _Body) -> tuple[Array, Array]:
    """Return begin and end of each capsule's segment in the world, (..., C, 3) each."""
    frames = chain.frames(positions)
    base = np.broadcast_to(body.base, (*frames.shape[:-3], 1, 4, 4))
    own = np.concatenate([frames, base], axis=-3)[..., body.links, :, :]
    origins, rotations = own[..., :3, 3], own[..., :3, :3]
    return origins + (rotations @ body.begin)[..., 0], origins + (rotations @ body.end)[..., 0]


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
