"""Rotations against SciPy, on random ones and on those where a form is singular."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vlatool.bundle.conversion import ROTATIONS
from vlatool.runtime.rotation import convert_rotation

COUNT = 10_000
LIMITS = {np.float64: 1e-12, np.float32: 3e-6}
"""Largest angle in rad between a rotation and what it is once it is converted."""


def singular() -> Rotation:
    """Return rotations by 0, pi and nearly that, and those in which two Euler axes lie in one line."""
    axes = np.concatenate([np.eye(3), -np.eye(3), [[1, 1, 1], [1, -2, 0], [0, 0.6, -0.8]]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = [0, 1e-300, 1e-12, 1e-7, 1e-4, np.pi / 2, np.pi - 1e-4, np.pi - 1e-7, np.pi - 1e-12, np.pi]
    turned = np.concatenate([axes * angle for angle in angles])
    locked = [
        Rotation.from_euler(order, [0.3, middle, -0.7])
        for order in ("xyz", "XYZ", "ZYX", "zyx", "zxz", "YXY")
        for middle in (np.pi / 2, -np.pi / 2, 0, np.pi, np.pi / 2 - 1e-9)
    ]
    return Rotation.concatenate([Rotation.from_rotvec(turned), *locked])


ALL = Rotation.concatenate([Rotation.random(COUNT, rng=0), singular()])


def written(rotations: Rotation, form: str) -> np.ndarray:
    """Return rotations as SciPy writes them."""
    kind, _, rest = form.partition("_")
    if kind == "euler":
        return rotations.as_euler(rest)
    matrices = rotations.as_matrix()
    if kind == "6d":
        matrices = matrices if "columns" in form else matrices.swapaxes(1, 2)
        pair = form[-2:] if form[-3:-2] == "_" else "xy"
        two = matrices[:, :, ["xyz".index(axis) for axis in pair]]
        return (two if "interleaved" in form else two.swapaxes(1, 2)).reshape(-1, 6)
    return {
        "axis_angle": lambda: rotations.as_rotvec(),
        "quaternion_xyzw": lambda: rotations.as_quat(canonical=True),
        "quaternion_wxyz": lambda: rotations.as_quat(canonical=True)[:, [3, 0, 1, 2]],
        "matrix": lambda: matrices.reshape(-1, 9),
    }[form]()  # fmt: skip


def apart(quaternions: np.ndarray) -> np.ndarray:
    """Return the angle in rad between each rotation and what it should be."""
    return np.asarray((Rotation.from_quat(quaternions) * ALL.inv()).magnitude())


def limits(form: str, dtype: type) -> np.ndarray:
    """Return the largest angle: next to gimbal lock, SciPy and this leave out up to 1e-7 rad about two axes."""
    found = np.full(len(ALL), LIMITS[dtype])
    if form.startswith("euler"):
        found[COUNT:] = max(3e-7, LIMITS[dtype])
    return found


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("dtype", LIMITS)
@pytest.mark.parametrize("form", ROTATIONS)
def test_every_form_is_scipys_there_and_back(form: str, dtype: type) -> None:
    given = written(ALL, form).astype(dtype)
    quaternions = convert_rotation(given, form, "quaternion_xyzw")
    assert quaternions.dtype == dtype
    assert (apart(quaternions) < limits(form, dtype)).all()
    back = convert_rotation(ALL.as_quat().astype(dtype), "quaternion_xyzw", form)
    assert back.shape == (len(ALL), ROTATIONS[form])
    again = convert_rotation(back.astype(np.float64), form, "quaternion_xyzw")
    assert (apart(again) < limits(form, dtype)).all()
    if dtype is np.float64 and form != "axis_angle":  # whose sign is either, at an angle of pi
        usual = slice(COUNT)
        np.testing.assert_allclose(back[usual], written(ALL[usual], form), atol=1e-9)


@pytest.mark.parametrize(("one", "two"), [*itertools.permutations(["axis_angle", "euler_ZYX", "6d_rows", "matrix"], 2)])
def test_forms_become_each_other(one: str, two: str) -> None:
    some = ALL[:200]
    np.testing.assert_allclose(convert_rotation(written(some, one), one, two), written(some, two), atol=1e-9)


def test_both_signs_of_a_quaternion_are_one_rotation_and_the_result_has_the_hemisphere_that_is_named() -> None:
    quaternions = ALL[:1000].as_quat()
    for form in ("axis_angle", "matrix", "euler_xyz", "6d_columns", "quaternion_wxyz"):
        one, other = (convert_rotation(sign * quaternions, "quaternion_xyzw", form) for sign in (1, -1))
        np.testing.assert_allclose(one, other, atol=1e-12)
    for sign, name in ((1, "positive"), (-1, "negative")):
        found = convert_rotation(quaternions, "quaternion_xyzw", "quaternion_xyzw", name)
        assert (sign * found[:, 3] >= 0).all()
    kept = convert_rotation(-quaternions * 3, "quaternion_xyzw", "quaternion_wxyz", "keep")
    np.testing.assert_allclose(kept, -quaternions[:, [3, 0, 1, 2]], atol=1e-12)


def robosuite(quaternion: np.ndarray) -> np.ndarray:
    """Return axis times angle as robosuite and LIBERO have them: angles up to 2 pi, by the sign of w."""
    sine = np.sqrt(1 - quaternion[3] ** 2)
    return np.zeros(3) if np.isclose(sine, 0) else quaternion[:3] * 2 * np.arccos(quaternion[3]) / sine


def test_the_angles_of_libero_go_beyond_pi() -> None:
    quaternions = np.concatenate([ALL[:500].as_quat(), -ALL[:500].as_quat(), [[0, 0, 0, 1], [0, 0, 0, -1]]])
    found = convert_rotation(quaternions, "quaternion_xyzw", "axis_angle", "keep")
    np.testing.assert_allclose(found, [robosuite(each) for each in quaternions], atol=1e-7)
    assert float(np.linalg.norm(found, axis=1).max()) > np.pi
    again = convert_rotation(found, "axis_angle", "quaternion_xyzw", "keep")
    np.testing.assert_allclose(again[:-1], quaternions[:-1], atol=1e-12)


@pytest.mark.parametrize(("form", "scale"), [("quaternion_xyzw", 1e-30), ("6d_rows", 1e30), ("matrix", 0.01)])
def test_the_scale_of_what_a_network_gives_does_not_count(form: str, scale: float) -> None:
    given = written(ALL[:100], form)
    np.testing.assert_allclose(convert_rotation(given * scale, form, "matrix"), written(ALL[:100], "matrix"), atol=1e-9)


def test_a_matrix_that_is_none_becomes_the_nearest_rotation() -> None:
    given = ALL[:300].as_matrix() + np.random.default_rng(1).normal(0, 0.3, (300, 3, 3))
    found = convert_rotation(given.reshape(-1, 9), "matrix", "matrix").reshape(-1, 3, 3)
    errors = np.linalg.norm(found - given, axis=(1, 2))
    others = np.linalg.norm(Rotation.random(300, rng=3).as_matrix() - given, axis=(1, 2))
    assert (errors <= others + 1e-12).all()
    np.testing.assert_allclose(found @ found.swapaxes(1, 2), np.broadcast_to(np.eye(3), found.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=1e-12)
    mirrored = convert_rotation(-ALL[:50].as_matrix().reshape(-1, 9), "matrix", "matrix").reshape(-1, 3, 3)
    np.testing.assert_allclose(np.linalg.det(mirrored), 1, atol=1e-12)


@pytest.mark.parametrize("form", ["quaternion_wxyz", "6d_columns", "6d_rows_interleaved", "matrix"])
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_is_no_rotation_is_not_a_number(form: str, value: float) -> None:
    given = np.full((2, ROTATIONS[form]), value, np.float32)
    given[1] = written(ALL[:1], form)[0]
    assert np.isnan(convert_rotation(given, form, "axis_angle")[0]).all()


def test_parallel_columns_are_no_rotation() -> None:
    assert np.isnan(convert_rotation(np.ones((1, 6)), "6d_columns", "matrix")).all()
