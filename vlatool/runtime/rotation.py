"""Rotations from one form to another: axis and angle, quaternions, Euler angles, matrices, and two of their columns.

Forms are those of ``vlatool.bundle.conversion.ROTATIONS``. All is computed in float64, by way of unit quaternions
(x, y, z, w), and both signs of a quaternion are the same rotation.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.conversion import PAIRS

Array = NDArray[Any]
LOCK_ANGLE = 1e-7
"""Angle in rad from gimbal lock below which the third Euler angle is 0, as SciPy has it."""
NOISE = 1e-12
"""Length, as a share of what it is a rest of, below which a direction is rounding."""


def convert_rotation(values: Array, before: str, after: str, hemisphere: str = "positive") -> Array:
    """Return rotations in another form.

    Args:
        values: (..., W) in the form ``before``, float32 or float64; a quaternion, a matrix or its columns of any scale.
        hemisphere: sign of w of the quaternion that results, or that the axis and angle result from: ``positive``
            (angles up to pi), ``negative`` (angles from pi to 2 pi) or ``keep``, the one of ``values``.

    Returns:
        (..., V) of the same dtype; NaN for values that are not a rotation, such as zeros for a quaternion.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        quaternions = _reader(before)(np.asarray(values, np.float64))
        if hemisphere != "keep":
            negative = quaternions[..., 3:] < 0
            quaternions = np.where(negative == (hemisphere == "positive"), -quaternions, quaternions)
        return _writer(after)(quaternions).astype(values.dtype)


def to_quaternions(values: Array, form: str) -> Array:
    """Return unit quaternions (..., 4), float64, of rotations in a form."""
    with np.errstate(invalid="ignore", divide="ignore"):
        quaternions: Array = _reader(form)(np.asarray(values, np.float64))
    return quaternions


def product(one: Array, two: Array) -> Array:
    """Return the Hamilton product of quaternions (..., 4): the rotation ``two``, then ``one``."""
    a, b, w, v = one[..., :3], two[..., :3], one[..., 3:], two[..., 3:]
    return np.concatenate([w * b + v * a + np.cross(a, b), w * v - (a * b).sum(axis=-1, keepdims=True)], axis=-1)


def inverse(quaternions: Array) -> Array:
    """Return the inverse of unit quaternions."""
    return np.asarray(quaternions * np.array([-1.0, -1.0, -1.0, 1.0]))


def turn(vectors: Array, quaternions: Array) -> Array:
    """Return vectors (..., 3) turned by unit quaternions."""
    xyz, w = quaternions[..., :3], quaternions[..., 3:]
    return np.asarray(vectors + 2 * np.cross(xyz, np.cross(xyz, vectors) + w * vectors))


def slerp(before: Array, after: Array, share: float | Array) -> Array:
    """Return the rotation at a share of the shortest way between unit quaternions (Shoemake 1985).

    Args:
        before: (..., 4).
        after: (..., 4); that of the two signs which is closer is used.
        share: 0 is ``before``, 1 is ``after``; beyond them, the turn goes on.

    Returns:
        (..., 4), float64, of length 1.
    """
    difference = product(after, inverse(before))
    difference = np.where(difference[..., 3:] < 0, -difference, difference)
    turned: Array = product(_from_axis_angle(_to_axis_angle(difference) * share), before)
    return turned


def _reader(form: str) -> Callable[[Array], Array]:
    kind, _, rest = form.partition("_")
    if kind == "euler":
        return functools.partial(_from_euler, order=rest)
    if kind == "6d":
        return functools.partial(_from_6d, form=form)
    return {
        "quaternion_xyzw": _unit, "quaternion_wxyz": lambda values: _unit(values[..., [1, 2, 3, 0]]),
        "axis_angle": _from_axis_angle, "matrix": _from_matrix,
    }[form]  # fmt: skip


def _writer(form: str) -> Callable[[Array], Array]:
    kind, _, rest = form.partition("_")
    if kind == "euler":
        return functools.partial(_to_euler, order=rest)
    if kind == "6d":
        return functools.partial(_to_6d, form=form)
    return {
        "quaternion_xyzw": lambda q: q, "quaternion_wxyz": lambda q: q[..., [3, 0, 1, 2]],
        "axis_angle": _to_axis_angle, "matrix": lambda q: _to_matrix(q).reshape(*q.shape[:-1], 9),
    }[form]  # fmt: skip


def _unit(vectors: Array) -> Array:
    """Vectors (..., N) of length 1; largest elements are taken out first, so that squares do not overflow."""
    scaled = vectors / np.abs(vectors).max(axis=-1, keepdims=True)
    unit: Array = scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return unit


def _from_axis_angle(vectors: Array) -> Array:
    angles = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([vectors * (0.5 * np.sinc(angles / (2 * np.pi))), np.cos(angles / 2)], axis=-1)


def _to_axis_angle(quaternions: Array) -> Array:
    """Axis times angle: 2 atan2(|xyz|, w), which is exact near 0 and near pi; zeros at an angle of 2 pi."""
    xyz, w = quaternions[..., :3], quaternions[..., 3:]
    sines = np.linalg.norm(xyz, axis=-1, keepdims=True)
    small = sines < np.finfo(np.float64).tiny
    vectors: Array = xyz * np.where(small, 2.0, 2 * np.arctan2(sines, w) / np.where(small, 1.0, sines))
    return vectors


def _from_matrix(values: Array) -> Array:
    """The nearest rotation to a matrix, row by row (Umeyama 1991: by its singular value decomposition)."""
    matrices = values.reshape(*values.shape[:-1], 3, 3)
    if not np.isfinite(matrices).all():
        return np.full((*values.shape[:-1], 4), np.nan)
    left, sizes, right = np.linalg.svd(matrices)
    signs = np.ones_like(sizes)
    signs[..., 2] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    none = sizes[..., 1:2] <= NOISE * sizes[..., :1]  # of rank one: no rotation is the nearest
    return np.where(none, np.nan, _of_rotation((left * signs[..., None, :]) @ right))


def _of_rotation(matrices: Array) -> Array:
    """Quaternions of rotation matrices (..., 3, 3), from the largest of the four elements (Shepperd 1978)."""
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    trace = diagonal.sum(axis=-1, keepdims=True)
    choice = np.concatenate([diagonal, trace], axis=-1).argmax(axis=-1)
    candidates = np.empty((*matrices.shape[:-2], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        candidates[..., i, i] = 1 - trace[..., 0] + 2 * matrices[..., i, i]
        candidates[..., i, j] = matrices[..., j, i] + matrices[..., i, j]
        candidates[..., i, k] = matrices[..., k, i] + matrices[..., i, k]
        candidates[..., i, 3] = candidates[..., 3, i] = matrices[..., k, j] - matrices[..., j, k]
    candidates[..., 3, 3] = 1 + trace[..., 0]
    return _unit(np.take_along_axis(candidates, choice[..., None, None], axis=-2)[..., 0, :])


def _to_matrix(quaternions: Array) -> Array:
    """Matrices (..., 3, 3) of unit quaternions."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _from_6d(values: Array, form: str) -> Array:
    """Two columns or rows, the second made perpendicular to the first (Zhou et al. 2019, arXiv 1812.07035)."""
    first, second, sides = _two(form)
    pairs = values.reshape(*values.shape[:-1], 3, 2) if "interleaved" in form else values.reshape(
        *values.shape[:-1], 2, 3
    ).swapaxes(-1, -2)  # fmt: skip
    one, second_unit = _unit(pairs[..., 0]), _unit(pairs[..., 1])
    rest = second_unit - (one * second_unit).sum(axis=-1, keepdims=True) * one
    parallel = np.abs(rest).max(axis=-1, keepdims=True) <= NOISE
    two = np.where(parallel, np.nan, _unit(rest))
    columns: list[Array] = [one] * 3
    columns[first], columns[second] = one, two
    third = np.cross(one, two)
    columns[3 - first - second] = third if (second - first) % 3 == 1 else -third
    matrices = np.stack(columns, axis=-1)
    return _of_rotation(matrices if sides == "columns" else matrices.swapaxes(-1, -2))


def _to_6d(quaternions: Array, form: str) -> Array:
    first, second, sides = _two(form)
    matrices = _to_matrix(quaternions)
    matrices = matrices if sides == "columns" else matrices.swapaxes(-1, -2)
    pair = matrices[..., [first, second]]
    pair = pair if "interleaved" in form else pair.swapaxes(-1, -2)
    return pair.reshape(*quaternions.shape[:-1], 6)


def _two(form: str) -> tuple[int, int, str]:
    """Return which two columns or rows a form has: x, y, z are 0, 1, 2."""
    words = form.split("_")
    pair = next((word for word in words if word in PAIRS), PAIRS[0])
    return "xyz".index(pair[0]), "xyz".index(pair[1]), words[1]


def _from_euler(angles: Array, order: str) -> Array:
    """Turns about axes one after the other: small letters about fixed axes, capitals about those that turn along."""
    turns = []
    for index, axis in enumerate(order.lower()):
        turn = np.zeros((*angles.shape[:-1], 4))
        turn[..., "xyz".index(axis)] = np.sin(angles[..., index] / 2)
        turn[..., 3] = np.cos(angles[..., index] / 2)
        turns.append(turn)
    first, second, third = turns if order.isupper() else reversed(turns)
    return product(product(first, second), third)


def _to_euler(quaternions: Array, order: str) -> Array:
    """Euler angles in [-pi, pi] (Bernardes and Viollet 2022, doi 10.1371/journal.pone.0276302, as SciPy has it)."""
    extrinsic = order.islower()
    i, j, k = ("xyz".index(axis) for axis in (order if extrinsic else order[::-1].lower()))
    symmetric = i == k
    k = 3 - i - j if symmetric else k
    sign = (i - j) * (j - k) * (k - i) // 2
    qi, qj, qk, w = (quaternions[..., index] for index in (i, j, k, 3))
    a, b, c, d = (w, qi, qj, qk * sign) if symmetric else (w - qj, qi + qk * sign, qj + w, qk * sign - qi)
    middle = 2 * np.arctan2(np.hypot(c, d), np.hypot(a, b))
    half_sum, half_difference = np.arctan2(b, a), np.arctan2(d, c)
    low, high = np.abs(middle) <= LOCK_ANGLE, np.abs(middle - np.pi) <= LOCK_ANGLE
    angles = np.empty((*quaternions.shape[:-1], 3))
    first, third = (0, 2) if extrinsic else (2, 0)
    angles[..., first], angles[..., third] = half_sum - half_difference, half_sum + half_difference
    angles[..., 1] = middle
    locked = np.where(low, 2 * half_sum, 2 * half_difference * (-1 if extrinsic else 1))
    angles[..., 0] = np.where(low | high, locked, angles[..., 0])
    angles[..., 2] = np.where(low | high, 0, angles[..., 2])
    if not symmetric:
        angles[..., third] *= sign
        angles[..., 1] -= np.pi / 2
    return np.where(angles < -np.pi, angles + 2 * np.pi, np.where(angles > np.pi, angles - 2 * np.pi, angles))
