"""The controllers of arms: names, start pose, stops, service, messages, limits; on an arm that obeys at once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _arm_feed import Arm, Scripted, joint_state, spec_of

from tests._arm_bundle import arm_bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.controllers import RobotController
from vlatool.errors import DeadlineMissed, UsageError
from vlatool.messages import same
from vlatool.messages.geometry_msgs import Point, Pose, PoseStamped
from vlatool.messages.sensor_msgs import Image, JointState
from vlatool.messages.std_msgs import Header, String
from vlatool.messages.trajectory_msgs import JointTrajectory
from vlatool.nodes.launch import PolicyOptions, open_controller
from vlatool.registry import load, names
from vlatool.runtime.kinematics import ARMS

ROBOTS = ("aloha", "franka", "so101", "ur5e")


def stay(observation: dict[str, Any]) -> Any:
    return observation["state"]


def built(
    name: str, act: Any = stay, mode: str = "absolute", others: tuple[TensorSpec, ...] = (), **settings: Any
) -> Any:
    entry = load("controllers", name)
    return entry(policy=Scripted(spec_of(entry.ROBOT.joints, mode, *others), act), **settings)


def differences(path: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    velocities = np.diff(path, axis=0) * rate
    return np.abs(velocities).max(axis=0), np.abs(np.diff(velocities, axis=0) * rate).max(axis=0)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_controller_is_one_and_says_what_its_robot_is(name: str) -> None:
    controller = built(name)
    robot = controller.ROBOT
    assert isinstance(controller, RobotController)
    assert name in names("controllers")
    assert len(robot.joints) == len(robot.driver_names) == len(robot.start) == {"aloha": 14, "franka": 7}.get(name, 6)
    assert controller.rate_hz == (30.0 if name == "so101" else 50.0)
    assert "speed: Share of the velocity limits" in controller.__doc__
    assert all(chain.links in [arm.links for arm in ARMS.values()] for chain in robot.chains.values())


@pytest.mark.parametrize("name", ROBOTS)
def test_an_arm_goes_to_its_start_pose_within_its_limits_and_then_does_what_the_policy_says(name: str) -> None:
    controller = built(name)
    limits = controller.ROBOT.limits().joints
    begin = np.array(controller.ROBOT.start) + [0.0 if joint.command == "range" else 0.4 for joint in limits]
    arm = Arm(controller, begin)
    command = arm.until("acting")
    assert command.status == "acting: at the start pose"
    assert arm.positions == pytest.approx(controller.ROBOT.start, abs=1e-12)
    fastest, hardest = differences(arm.path(), controller.rate)
    for joint, velocity, acceleration in zip(limits, fastest, hardest, strict=True):
        if joint.command != "range":
            assert 0.0 < velocity <= controller.speed * joint.velocity[1] + 1e-9
            assert acceleration <= controller.acceleration * joint.acceleration + 1e-6
    assert all(not command.notes.get("checks") for command in arm.commands)  # the way is within the limits by itself
    assert controller.policy.resets == 2  # at start, and when it begins to act


def test_commands_are_stamped_trajectories_by_the_driver_s_names() -> None:
    arm = Arm(built("ur5e", lead_s=0.04))
    command = arm.steps(3)
    (message,) = command.messages["trajectory"]
    assert isinstance(message, JointTrajectory)
    assert message.joint_names[0] == "shoulder_pan_joint"
    assert message.header.stamp.seconds == pytest.approx(arm.time_s)
    assert message.points[0].time_from_start.seconds == pytest.approx(0.04)


def test_joint_states_are_an_output_for_ros_1() -> None:
    arm = Arm(built("so101", output="joint_state", joint_names=tuple("abcdef")))
    (message,) = arm.steps(3).messages["command"]
    assert isinstance(message, JointState)
    assert message.name == tuple("abcdef")
    assert message.header.stamp.seconds == pytest.approx(arm.time_s)


@pytest.mark.parametrize("name", ROBOTS)
def test_joints_are_told_apart_by_name_and_never_by_place(name: str) -> None:
    def drift(observation: dict[str, Any]) -> Any:
        return observation["state"] + np.linspace(0.001, 0.004, len(observation["state"]), dtype=np.float32)

    runs = []
    for order in (None, np.random.default_rng(1).permutation(len(load("controllers", name).ROBOT.joints))):
        arm = Arm(built(name, drift), order=order)
        arm.steps(60)
        runs.append(arm)
    assert runs[0].path().tobytes() == runs[1].path().tobytes()
    assert np.ptp(runs[0].path(), axis=0).max() > 0.03


def test_labels_of_a_policy_in_another_order_are_followed() -> None:
    entry = load("controllers", "ur5e")
    backwards = tuple(reversed(entry.ROBOT.joints))
    action = TensorSpec("action", (1, 1, 6), labels=backwards, mode="absolute")
    spec = spec_of(entry.ROBOT.joints)
    controller = entry(policy=Scripted(type(spec)(spec.inputs, (action,), 50.0), lambda seen: seen["state"][::-1]))
    arm = Arm(controller)
    arm.until("acting")
    arm.steps(5)
    assert arm.positions == pytest.approx(entry.ROBOT.start, abs=1e-6)


def broken(message: JointState, how: str) -> JointState:
    names, positions = list(message.name), message.position.copy()
    if how == "missing":
        names, positions = names[:-1], positions[:-1]
    if how == "doubled":
        names, positions = [*names, names[0]], np.append(positions, 0.3)
    if how == "lengths":
        positions = positions[:-2]
    if how == "nan":
        positions[2] = math.nan
    return JointState(message.header, tuple(names), positions)


@pytest.mark.parametrize(
    ("how", "words"),
    [("missing", "without the joint 'wrist_3_joint'"), ("doubled", "2 times with the joint 'shoulder_pan_joint'"),
     ("lengths", "6 names and 4 values"), ("nan", "no number for the joint elbow_joint")],
)  # fmt: skip
def test_a_joint_state_that_is_wrong_stops_the_arm_and_says_why(how: str, words: str) -> None:
    def forward(observation: dict[str, Any]) -> Any:
        return observation["state"] + np.float32(0.008)

    arm = Arm(built("ur5e", forward))
    arm.until("acting")
    arm.steps(30)
    moving = np.abs(np.diff(arm.path()[-2:], axis=0)).max()
    state = broken(joint_state(arm.names, arm.positions), how)
    for _ in range(60):
        state = broken(joint_state(arm.names, arm.positions, arm.time_s + 0.02), how)
        command = arm.step(state=state)
    assert words in command.status
    assert moving > 0.001
    assert np.abs(np.diff(arm.path()[-2:], axis=0)).max() == 0.0
    assert arm.state.envelope.at_rest()
    arm.steps(30)
    assert np.abs(np.diff(arm.path()[-2:], axis=0)).max() > 0.001  # it goes on when the state is right again


@pytest.mark.parametrize("repeated", [False, True])
def test_an_old_joint_state_stops_the_arm(repeated: bool) -> None:
    arm = Arm(built("franka", lambda seen: seen["state"] + np.float32(0.008)))
    arm.until("acting")
    arm.steps(20)
    frozen = joint_state(arm.names, arm.positions, arm.time_s)
    command = arm.steps(60, state=frozen) if repeated else arm.steps(60, silent=True)
    assert "joint state 1.2 s old" in command.status
    assert np.abs(np.diff(arm.path()[-2:], axis=0)).max() == 0.0
    _, hardest = differences(arm.path(), 50.0)
    assert (hardest <= [joint.acceleration + 1e-6 for joint in arm.controller.ROBOT.limits().joints]).all()


@pytest.mark.parametrize("away", [0.3, 2.0])
@pytest.mark.parametrize("name", ROBOTS)
def test_an_arm_that_is_elsewhere_after_a_silence_is_commanded_from_where_it_is(name: str, away: float) -> None:
    """Its driver, or the robot, started again: the last command is no place to leap to."""
    arm = Arm(built(name, lambda seen: seen["state"], speed=0.4))
    arm.until("acting")
    arm.steps(5)
    command = arm.steps(80, silent=True)
    assert arm.state.envelope.at_rest()
    assert "joint state" in command.status
    assert not command.messages  # what starts again finds no command of before
    limits = arm.controller.ROBOT.limits(0.4, arm.controller.margin_rad).joints
    shifts = [0.0 if joint.command == "range" else away for joint in limits]
    arm.positions = np.array([
        value + shift if value + shift < joint.bounds[1] else max(value - shift, joint.bounds[0])
        for value, shift, joint in zip(arm.positions, shifts, limits, strict=True)
    ])  # fmt: skip
    places = [arm.positions]
    for _ in range(60):
        arm.step()
        places.append(arm.positions)
    fastest, _ = differences(np.array(places), arm.controller.rate)
    assert all(speed <= joint.velocity[1] + 1e-9 for speed, joint in zip(fastest, limits, strict=True)
               if joint.command != "range")  # fmt: skip
    assert arm.commands[-1].status.startswith("acting")
    assert arm.state.envelope.position == pytest.approx(places[0], abs=1e-6)


def test_an_arm_that_is_beyond_its_limits_after_a_silence_is_not_commanded_to_leap_back() -> None:
    arm = Arm(built("franka", lambda seen: seen["state"], start_pose=(0, 0, 0, -0.2, 0, 1.5, 0), margin_rad=0.02))
    arm.until("acting")
    arm.steps(80, silent=True)
    before = arm.state.envelope.position
    beyond = np.array(before)
    beyond[3] = 0.05
    for _ in range(10):
        command = arm.step(state=joint_state(arm.names, beyond, arm.time_s + 0.02))
        assert "joint4 is at 0.05; its limits are" in command.status
        assert not command.messages
    arm.steps(3, state=None)
    assert command.status.startswith("acting")


def test_what_an_arm_lags_behind_its_command_is_no_reason_to_command_another_place() -> None:
    arm = Arm(built("franka", lambda seen: seen["state"] * 0 + arm.positions.astype(np.float32)))
    arm.until("acting")
    arm.steps(5)
    before = arm.state.envelope.position
    arm.steps(80, silent=True)
    sagging = joint_state(arm.names, arm.positions - 0.01, arm.time_s + 0.02)
    arm.step(state=sagging)
    assert arm.state.envelope.position == pytest.approx(before, abs=1e-6)


def test_nothing_is_sent_before_the_first_good_joint_state() -> None:
    arm = Arm(built("franka"))
    command = arm.step(silent=True, calls=1)
    assert (command.status, dict(command.messages)) == ("waiting: no joint state", {})
    assert [response.success for response in command.responses.values()] == [False]
    outside = arm.positions.copy()
    outside[3] = 0.5
    for count in range(1, 4):
        command = arm.step(state=joint_state(arm.names, outside, 0.1 * count))
    assert command.status.startswith("waiting: joint4 is at 0.5; its limits are")
    assert not command.messages


def test_the_service_brings_the_arm_back_and_answers_when_it_is_there() -> None:
    arm = Arm(built("ur5e", lambda seen: seen["state"] + np.float32(0.01)))
    arm.until("acting")
    arm.steps(50)
    command = arm.step(calls=2)
    assert command.status == "returning: stopping first"
    assert not command.responses
    command = arm.until("acting")
    assert [(answer.success, answer.message) for answer in command.responses.values()] == [
        (True, "at the start pose")
    ] * 2
    assert arm.positions == pytest.approx(arm.controller.ROBOT.start, abs=1e-12)
    fastest, hardest = differences(arm.path(), 50.0)
    assert (fastest <= 0.5 * math.pi + 1e-9).all()
    assert (hardest <= 3.0 + 1e-6).all()


@pytest.mark.parametrize("speed", [0.1, 1.0])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_call_of_the_service_waits_for_the_longest_way(name: str, speed: float) -> None:
    """From one end of all joints to the other."""
    joints = built(name).ROBOT.limits(speed, built(name).margin_rad).joints
    low, high = (tuple(joint.bounds[side] for joint in joints) for side in (0, 1))
    arm = Arm(built(name, speed=speed, start_pose=high), low)
    arm.step()
    while arm.state.phase == "returning":
        arm.steps(10)
    assert arm.controller.services[0].answer_s > arm.time_s


@pytest.mark.parametrize("act", [lambda seen: np.full(7, np.nan, np.float32), lambda seen: np.zeros(3, np.float32),
                                 lambda seen: np.full(7, 9.0, np.float32), lambda seen: [0.0] * 6])  # fmt: skip
def test_what_a_policy_must_not_say_moves_nothing(act: Any) -> None:
    arm = Arm(built("franka", act))
    arm.until("acting")
    arm.steps(20)
    assert np.ptp(arm.path()[-20:], axis=0).max() == 0.0


def test_a_policy_that_misses_its_deadline_stops_the_arm_with_its_words() -> None:
    def late(observation: dict[str, Any]) -> Any:
        raise DeadlineMissed("The inference took 30 ms; its deadline is 20 ms.")

    arm = Arm(built("franka", late))
    arm.until("acting")
    assert "its deadline is 20 ms" in arm.step().status


@pytest.mark.parametrize(("mode", "value"), [("delta", 0.004), ("velocity", 0.2)])
def test_differences_and_velocities_go_on_from_the_command(mode: str, value: float) -> None:
    arm = Arm(built("ur5e", lambda seen: np.full(6, value, np.float32), mode))
    arm.until("acting")
    arm.steps(100)
    assert np.diff(arm.path()[-2:], axis=0)[0] == pytest.approx([0.004] * 6, rel=1e-5)


def test_an_arm_that_is_moved_by_hand_stops_and_stays_where_it_is() -> None:
    pose = np.array(load("controllers", "franka").ROBOT.start, np.float32)
    arm = Arm(built("franka", lambda _: pose, max_lag_rad=0.1))
    arm.until("acting")
    arm.steps(10)
    elsewhere, statuses = arm.positions.copy(), []
    for _ in range(60):
        elsewhere[0] += 0.02  # a radian a second
        statuses.append(arm.step(state=joint_state(arm.names, elsewhere, arm.time_s + 0.02)).status)
    assert any("panda_joint1 is 0.1" in status for status in statuses)
    assert arm.positions[0] == pytest.approx(elsewhere[0], abs=0.11)


@pytest.mark.parametrize("count", [1, 2, 50])
def test_joint_states_that_jump_move_no_arm(count: int) -> None:
    arm = Arm(built("franka", max_lag_rad=0.1))
    arm.until("acting")
    arm.steps(10)
    before = arm.positions.copy()
    wrong = before.copy()
    wrong[1] += 1.0
    for _ in range(count):
        command = arm.step(state=joint_state(arm.names, wrong, arm.time_s + 0.02))
        assert command.status == "acting: panda_joint2 jumped by 1.00 rad"
        assert arm.positions == pytest.approx(before, abs=1e-3)
    assert "jumped" not in arm.step().status
    assert arm.positions == pytest.approx(before, abs=1e-3)


def test_an_arm_that_moved_while_nothing_was_heard_is_believed() -> None:
    arm = Arm(built("franka", max_lag_rad=0.1))
    arm.until("acting")
    for _ in range(50):
        arm.step(silent=True)
    elsewhere = arm.positions.copy()
    elsewhere[0] += 0.5
    arm.step(state=joint_state(arm.names, elsewhere, arm.time_s + 0.02))
    assert arm.positions == pytest.approx(elsewhere, abs=1e-3)


def test_a_driver_that_begins_with_zeros_begins_no_way_from_there() -> None:
    arm = Arm(built("franka"), positions=load("controllers", "franka").ROBOT.start)
    for positions in (np.zeros(7), np.zeros(7)):
        command = arm.step(state=joint_state(arm.names, positions, arm.time_s + 0.02))
        assert not command.messages
        arm.positions = np.array(arm.controller.ROBOT.start)
    assert command.status == "waiting: joint states that agree"
    arm.until("acting")
    assert all(np.allclose(arm.sent(command), arm.controller.ROBOT.start, atol=0.01)
               for command in arm.commands if command.messages)  # fmt: skip


@pytest.mark.parametrize("settings", [{"max_age_s": 1e9}, {"max_lag_rad": 1e9}, {"max_lag_rad": -1.0}])
def test_settings_that_switch_a_check_off_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=r"allowed: from 0\.001 to"):
        built("franka", **settings)


def test_the_same_snapshot_and_state_give_the_same_command() -> None:
    arm = Arm(built("aloha", lambda seen: seen["state"] + np.float32(0.001)))
    arm.steps(40)
    state, positions, time_s, newest = arm.state, arm.positions, arm.time_s, dict(arm.newest)
    first = arm.step()
    arm.steps(20)
    arm.state, arm.positions, arm.time_s, arm.newest = state, positions, time_s, newest
    again = arm.step()
    assert all(
        same(one, two)
        for name in first.messages
        for one, two in zip(first.messages[name], again.messages[name], strict=True)
    )


def test_the_arms_of_aloha_never_come_near_each_other() -> None:
    """Both are told to reach across the table: they stop before, and go back when they are told to."""
    direction = [1.0]

    def across(observation: dict[str, Any]) -> Any:
        wanted = observation["state"].copy()
        wanted[[1, 8]] += np.float32(0.015 * direction[0])
        wanted[[2, 9]] -= np.float32(0.015 * direction[0])
        return wanted

    arm = Arm(built("aloha", across))
    arm.until("acting")
    command = arm.steps(110)
    distance = arm.controller._apart().distance
    assert "apart" in command.notes["checks"]
    assert 0.09 <= distance(arm.path()).min() < 0.2
    direction[0] = -1.0
    arm.steps(50)
    assert distance(arm.path()[-1:])[0] > 0.2


def test_no_joint_of_aloha_changes_the_distance_faster_than_its_reach_says() -> None:
    """What lets the envelope leave out distances: for any two poses, near ones and far ones."""
    keep, random = built("aloha")._apart(), np.random.default_rng(6)
    joints = load("controllers", "aloha").ROBOT.limits().joints
    low, high = (np.array([joint.bounds[side] for joint in joints]) for side in (0, 1))
    poses = random.uniform(low, high, (4000, 14))
    poses[:2000] = np.array(load("controllers", "aloha").ROBOT.start) + random.uniform(-0.8, 0.8, (2000, 14))
    others = poses + random.standard_normal((4000, 14)) * 10.0 ** random.uniform(-3, 0, (4000, 1))
    changes = np.abs(keep.distance(poses) - keep.distance(others))
    bounds = np.abs(poses - others) @ np.array(keep.reach_m)
    assert (changes <= bounds + 1e-12).all()
    assert (changes / bounds).max() > 0.3  # and it says no more than it must


def test_a_way_that_is_not_free_ends_where_it_is_and_the_call_is_told() -> None:
    """The start pose of the right arm is behind the left one, which reaches across."""
    pose = np.array(load("controllers", "aloha").ROBOT.start)
    across = pose.copy()
    across[1], across[2] = 0.5, 0.4
    arm = Arm(
        built("aloha", return_at_start=False, start_pose=(*across[:7], *across[7:8], 0.5, 0.4, *across[10:])), pose
    )
    arm.steps(3)
    command = arm.step(calls=1)
    for _ in range(400):
        if command.responses:
            break
        command = arm.step()
    assert [answer.success for answer in command.responses.values()] == [False]
    assert command.status == "stopped: the way is not free"


def test_a_policy_sees_targets_cameras_and_an_instruction() -> None:
    others = (TensorSpec("target", (1, 3)), TensorSpec("wrist", (1, 2, 3, 3), "uint8"),
              TensorSpec("task", (1, 4), "int64", "text", tokenizer="t.json", max_tokens=4))  # fmt: skip
    arm = Arm(built("franka", others=others, return_at_start=False))
    assert [entry.topic for entry in arm.controller.inputs] == [
        "/joint_states",
        "/target",
        "/wrist/image_raw",
        "/instruction",
    ]
    assert [entry.name for entry in arm.controller.inputs if entry.required] == ["joints", "target", "wrist"]
    assert "no target" in arm.steps(3).status
    assert "no target" not in (status := arm.step(target=PoseStamped(pose=Pose(Point(0.1, 0.2, 0.3)))).status)
    assert "camera wrist: no image" in status
    pixels = np.arange(18, dtype=np.uint8)
    assert "no instruction" in arm.step(wrist=Image(Header(), 2, 3, "rgb8", 0, 9, pixels)).status
    arm.step(instruction=String("wipe"))
    seen = arm.controller.policy.seen[-1]
    assert seen["target"] == pytest.approx([0.1, 0.2, 0.3])
    assert (seen["wrist"].tobytes(), seen["task"]) == (pixels.tobytes(), "wipe")
    bad = PoseStamped(pose=Pose(Point(0.1, math.nan, 0.3)))
    assert "not a place" in arm.step(target=bad).status


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"output": "torque"}, "Unknown output 'torque'"),
        ({"speed": 0.0}, "speed is 0.0"),
        ({"speed": 1.5}, "speed is 1.5"),
        ({"acceleration": 0.0}, "acceleration is 0.0"),
        ({"rate": 0.0}, "rate is 0.0"),
        ({"margin_rad": -0.1}, "margin_rad is -0.1"),
        ({"max_age_s": 0.0}, "max_age_s is 0.0"),
        ({"joint_names": ("a", "b")}, "joint_names has 2 names"),
        ({"joint_names": tuple("aacdefg")}, "6 of them different"),
        ({"start_pose": (0.0,)}, "start_pose has 1 numbers"),
        ({"start_pose": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)}, "joint4 at 0"),
    ],
)
def test_bad_settings_are_refused_with_what_is_allowed(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        load("controllers", "franka")(**settings)


SEVEN = tuple(f"joint{number}" for number in range(1, 8))


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        (lambda: spec_of(SEVEN[:6]), "franka-panda has the joints"),
        (lambda: spec_of(SEVEN, "relative"), "mode 'relative'"),
        (lambda: spec_of(SEVEN, unit="deg"), "in deg; the robot takes rad"),
        (lambda: spec_of(SEVEN, "absolute", TensorSpec("force", (1, 6))), "'force' of the policy is neither"),
        (lambda: spec_of(SEVEN, "absolute", TensorSpec("target", (1, 6))), "'target' has 6 elements"),
    ],
)
def test_policies_of_other_robots_are_refused(spec: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        load("controllers", "franka")(policy=Scripted(spec(), stay))


def test_without_a_policy_it_does_not_start() -> None:
    controller = load("controllers", "franka")()
    assert [entry.name for entry in controller.inputs] == ["joints"]
    with pytest.raises(UsageError, match="--bundle"):
        controller.start()
    assert not controller.rest().messages


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a policy of a Panda that asks for where the arm is."""
    folder = tmp_path_factory.mktemp("arm") / "bundle"
    arm_bundle(folder)
    return folder


@pytest.mark.parametrize("robot", ["", "franka-panda"])
def test_a_policy_acts_after_each_return_to_the_start_pose(bundle: Path, robot: str) -> None:
    """Limits are kept once: what it said before the arm went back holds it nowhere."""
    controller = open_controller("franka", {"return_at_start": False}, PolicyOptions(bundle, robot, deadline_ms=0))
    arm = Arm(controller, np.array(controller.ROBOT.start) + 0.4)
    for _ in range(2):
        arm.until("acting")
        commands = [arm.step() for _ in range(30)]
        assert {command.status for command in commands[1:]} == {"acting"}
        arm.step(calls=1)
    assert arm.positions == pytest.approx(controller.ROBOT.start, abs=0.01)


def test_another_robot_than_that_of_the_controller_is_refused(bundle: Path) -> None:
    with pytest.raises(UsageError, match=r"keeps the limits of franka-panda, and --robot is ur5e"):
        open_controller("franka", {}, PolicyOptions(bundle, "ur5e"))
