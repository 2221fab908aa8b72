"""Forward kinematics and Jacobians: against MuJoCo, by models written here and, where installed, the packages'."""

from __future__ import annotations

import math

import numpy as np
import pytest
from _full import small_or_full

from vlatool.errors import MissingExtra, UsageError
from vlatool.runtime.kinematics import ARMS, Chain, Link, Pose, arm, from_modified_dh, from_standard_dh
from vlatool.worlds import aloha, franka_panda, so101, ur5e
from vlatool.worlds._arm_model import compile_model

POSES = small_or_full(200, 100_000)
UR_DH = (
    (0.0, 0.1625, 90),
    (-0.425, 0.0, 0),
    (-0.3922, 0.0, 0),
    (0.0, 0.1333, 90),
    (0.0, 0.0997, -90),
    (0.0, 0.0996, 0),
)
MODELS = {
    "franka_panda": (franka_panda.FrankaPanda, "link7", (0.0, 0.0, 0.0)),
    "ur5e_robosuite": (ur5e.Ur5e, "wrist_3_link", (0.0, 0.0, 0.0)),
    "so101": (so101.So101, "gripper", (0.0, 0.0, 0.0)),
    "viperx_300": (aloha.Aloha, "vx300s_left/gripper_link", (-0.469, 0.5, 0.0)),
}
"""Arm -> world with its model, last body, and place of its base."""


def dh_model(rows: tuple[tuple[float, float, float], ...], *, modified: bool) -> str:
    """An MJCF model of DH rows (a, d, alpha in degrees): for each row a body that turns, and one that does not."""
    text, ends = "", ""
    for index, (a, d, alpha) in enumerate(rows):
        turning = f'<joint name="j{index}" axis="0 0 1"/><geom size="0.01" mass="1"/>'
        before = f'<body pos="{a} 0 0" euler="{alpha} 0 0">'
        if modified:
            text += f'{before}<body name="l{index}" pos="0 0 {d}">{turning}'
        else:
            text += f'<body name="b{index}">{turning}<body name="l{index}" pos="{a} 0 {d}" euler="{alpha} 0 0">'
        ends += "</body></body>"
    return f'<mujoco><compiler angle="degree"/><worldbody>{text}{ends}</worldbody></mujoco>'


def compare(
    chain: Chain, model: object, body: str, count: int, base: tuple[float, float, float], *, end: bool
) -> tuple[float, float]:
    """Return the largest difference of poses and of Jacobians at random positions of the joints."""
    import mujoco

    data, joints = mujoco.MjData(model), len(chain.links)
    positions = np.random.default_rng(3).uniform(-math.pi, math.pi, (count, joints))
    frames = chain.tip_pose(positions) if end else chain.frames(positions)[:, -1]
    tips, jacobians = chain.tip_position(positions), chain.jacobian(positions)
    number, poses, columns = model.body(body).id, 0.0, 0.0
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for row, values in enumerate(positions):
        data.qpos[:joints] = values
        mujoco.mj_kinematics(model, data)
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = data.xmat[number].reshape(3, 3), data.xpos[number] - base
        poses = max(poses, float(np.abs(found - frames[row]).max()))
        mujoco.mj_comPos(model, data)
        mujoco.mj_jac(model, data, linear, angular, tips[row] + base, number)
        columns = max(columns, float(np.abs(np.vstack([linear, angular])[:, :joints] - jacobians[row]).max()))
    return poses, columns


@pytest.mark.parametrize("name", sorted(MODELS))
def test_arms_are_where_mujoco_has_them(name: str) -> None:
    world, body, base = MODELS[name]
    try:
        model = compile_model(world.SETUP.file.find(), True)
    except MissingExtra as error:
        pytest.skip(f"{error.message} (test_tables_are_those_of_dh_models covers the computation)")
    poses, columns = compare(arm(name), model, body, POSES, base, end=False)
    assert max(poses, columns) < 1e-6


def test_tables_are_those_of_dh_models() -> None:
    mujoco = pytest.importorskip("mujoco", reason="the extra worlds is not installed")
    panda = (
        (0.0, 0.333, 0),
        (0, 0, -90),
        (0, 0.316, 90),
        (0.0825, 0, 90),
        (-0.0825, 0.384, -90),
        (0, 0, 90),
        (0.088, 0, 90),
    )
    model = mujoco.MjModel.from_xml_string(dh_model(panda, modified=True))
    assert max(compare(Chain(arm("franka_panda").links), model, "l6", POSES, (0, 0, 0), end=True)) < 1e-9
    model = mujoco.MjModel.from_xml_string(dh_model(UR_DH, modified=False))
    assert max(compare(arm("ur5e"), model, "l5", POSES, (0, 0, 0), end=True)) < 1e-9


def test_a_planar_arm_has_the_positions_of_the_school_formula() -> None:
    chain = from_standard_dh(("shoulder", "elbow"), ((0.3, 0.0, 0.0), (0.2, 0.0, 0.0)))
    first, second = 0.4, -1.1
    expected = [
        0.3 * math.cos(first) + 0.2 * math.cos(first + second),
        0.3 * math.sin(first) + 0.2 * math.sin(first + second),
        0,
    ]
    assert chain.tip_position([first, second]) == pytest.approx(expected, abs=1e-15)
    assert from_modified_dh(("only",), ((0.1, 0.2, 0.0),)).tip_position([0.0]) == pytest.approx([0.1, 0.0, 0.2])


@pytest.mark.parametrize("name", sorted(ARMS))
def test_jacobians_are_the_derivatives_of_positions(name: str) -> None:
    chain, step = arm(name), 1e-6
    positions = np.random.default_rng(4).uniform(-1.5, 1.5, (20, len(chain.links)))
    for joint in range(len(chain.links)):
        shift = np.eye(len(chain.links))[joint] * step
        moved = (chain.tip_position(positions + shift) - chain.tip_position(positions - shift)) / (2 * step)
        assert np.abs(moved - chain.jacobian(positions)[:, :3, joint]).max() < 1e-8


def test_many_poses_at_a_time_are_the_same_as_one_by_one() -> None:
    chain = arm("viperx_300")
    positions = np.random.default_rng(5).uniform(-1, 1, (3, 4, 6))
    together = chain.frames(positions)
    assert together.shape == (3, 4, 6, 4, 4)
    assert np.array_equal(together[1, 2], chain.frames(positions[1, 2]))


def test_a_base_moves_all_frames() -> None:
    links = (Link("turn", (0.1, 0.0, 0.0)),)
    chain = Chain(links, Pose((0.1, 0.0, 0.0)), Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 1.0)))
    assert chain.tip_position([0.0]) == pytest.approx([1.0, 2.2, 3.0])


@pytest.mark.parametrize(
    ("attempt", "words"),
    [
        (lambda: arm("ur3"), "known: franka_panda, so101, ur5e"),
        (lambda: arm("so101").frames([0.0] * 4), "for 5 joints"),
        (lambda: Chain(()), r"has the joints \[\]"),
        (lambda: Chain((Link("a", (0, 0, 0)), Link("a", (0, 0, 0)))), "each name once"),
        (lambda: Chain((Link("a", (0, 0, 0), axis=(0.0, 0.0, 2.0)),)), "axes of length 1"),
    ],
)
def test_bad_tables_and_positions_are_refused(attempt: object, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        attempt()
