"""Any policy as a controller: topics to inputs, actions to messages, and what is refused by name."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.controllers import Reading, Snapshot, with_policy
from vlatool.controllers._policy_proposal import propose
from vlatool.controllers.policy import Policy
from vlatool.errors import DeadlineMissed, UsageError
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.pixels import image_message
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import Header, String
from vlatool.messages.trajectory_msgs import JointTrajectory

JOINTS = ("pan", "lift", "grip")
CAMERA = TensorSpec("image", (1, 4, 6, 3), "uint8", unit="rgb")
STATE = TensorSpec("state", (1, 3), unit=("deg", "rad", "mm"), labels=JOINTS)
TEXT = TensorSpec("task", (1, 4), "int64", kind="text", tokenizer="vocabulary.json", max_tokens=4)
ARM = TensorSpec("action", (1, 1, 3), labels=JOINTS, unit=("deg", "rad", "mm"), mode="absolute")
SPEEDS = TensorSpec("action", (1, 2), labels=("forward", "turn"), unit=("m/s", "rad/s"), mode="velocity")
MOVES = TensorSpec("logits", (1, 3), kind="discrete", labels=("left", "right", "forward"))
PAST = TensorSpec("past", (1, 3), "int64")
FRAMES = TensorSpec("image", (1, 3, 4, 6, 3), "uint8", unit="rgb")


@dataclass
class Plays:
    """A policy whose action is told to it; it keeps what it was asked."""

    spec: PolicySpec
    action: object = None
    asked: list = field(default_factory=list)
    resets: int = 0

    def act(self, observation):
        self.asked.append(observation)
        if isinstance(self.action, Exception):
            raise self.action
        return np.asarray(self.action)

    def reset(self, seed=None):
        self.resets += 1


def spec_of(inputs=(CAMERA, STATE, TEXT), action=ARM, hz=10.0) -> PolicySpec:
    return PolicySpec(inputs, (action,), hz)


def controller_of(policy: Plays, values=None, **settings) -> Policy:
    settings = {"settle_s": 0.0, **settings}
    return with_policy(Policy(propose(policy.spec) if values is None else values, **settings), policy)


def joints(positions, names=JOINTS, at=0.0, **more) -> JointState:
    return JointState(Header(Time.from_seconds(1000 + at)), names, np.asarray(positions, float), **more)


def picture(value=7, encoding="rgb8") -> object:
    pixels = np.full((4, 6, 3), value, np.uint8)
    pixels[..., 0] = 200
    return image_message(pixels, encoding, Header(Time.from_seconds(1000)))


class Feed:
    """Steps a controller with the messages that came, at 10 Hz."""

    def __init__(self, controller):
        self.controller, self.state, self.tick = controller, controller.start(), 0
        self.newest, self.counts = {}, {}

    def __call__(self, **messages):
        now, readings = self.tick / 10, {}
        for name, message in messages.items():
            number = self.counts[name] = self.counts.get(name, -1) + 1
            readings[name] = (Reading(message, now, number),)
            self.newest[name] = readings[name][-1]
        self.snapshot = Snapshot(now, Time.from_seconds(1000 + now), readings, dict(self.newest))
        command, self.state = self.controller.step(self.snapshot, self.state)
        self.tick += 1
        return command


def test_joints_by_name_in_the_units_of_the_spec_and_back():
    policy = Plays(spec_of(), np.array([180.0, 0.5, 20.0], np.float32))
    feed = Feed(controller_of(policy))
    command = feed(image=picture(), task=String(" pick it "),
                   state=joints([0.04, 9, math.pi / 2, 0.25], ("grip", "other", "pan", "lift")))  # fmt: skip
    assert command.status == "acting policy"
    asked = policy.asked[0]
    assert asked["state"] == pytest.approx([90, 0.25, 40])
    assert asked["state"].dtype == np.float32
    assert asked["task"] == "pick it"
    assert asked["image"].shape == (4, 6, 3)
    assert list(asked["image"][0, 0]) == [200, 7, 7]
    (message,) = command.messages["action"]
    assert isinstance(message, JointTrajectory)
    assert message.joint_names == JOINTS
    assert message.points[0].positions == pytest.approx([math.pi, 0.5, 0.02])
    assert message.points[0].time_from_start.seconds == 0.1


@pytest.mark.parametrize(("encoding", "first"), [("rgb8", [200, 7, 7]), ("bgr8", [7, 7, 200])])
def test_colours_are_ordered_by_the_encoding(encoding, first):
    policy = Plays(spec_of((CAMERA,), SPEEDS), [0.1, 0.2])
    Feed(controller_of(policy))(image=picture(encoding=encoding))
    assert list(policy.asked[0]["image"][0, 0]) == first


def test_speeds_become_a_twist_and_stop_when_the_camera_is_old():
    policy = Plays(spec_of((CAMERA,), SPEEDS), [0.1, -0.2])
    feed = Feed(controller_of(policy))
    assert feed().status == "waiting: 'image' has no sample"
    (twist,) = feed(image=picture()).messages["action"]
    assert (twist.linear.x, twist.angular.z) == (0.1, -0.2)
    commands = [feed() for _ in range(7)]
    assert [command.messages["action"][0].linear.x for command in commands] == [0.1] * 5 + [0.0] * 2
    assert commands[-1].status == "waiting: 'image' is 0.7 s old; allowed: 0.5 s"


@pytest.mark.parametrize("message", [JointTrajectory.TYPE, JointState.TYPE])
def test_differences_are_added_to_where_the_joints_are(message):
    spec = spec_of((STATE,), replace(ARM, mode="delta"))
    values = propose(spec)
    values["output"]["type"] = message
    feed = Feed(controller_of(Plays(spec, [90.0, 0.1, -10.0]), values))
    command = feed(state=joints([0.04, 0.5, 0.25], ("grip", "pan", "lift")))
    (sent,) = command.messages["action"]
    positions = sent.position if message == JointState.TYPE else sent.points[0].positions
    assert positions == pytest.approx([0.5 + math.pi / 2, 0.35, 0.03])


def test_discrete_actions_frames_and_past_actions():
    policy = Plays(spec_of((FRAMES, PAST), MOVES), 2)
    feed = Feed(controller_of(policy))
    commands = [feed(image=picture(value)) for value in (1, 2, 3, 4)]
    assert commands[0].messages["action"] == (commands[0].messages["action"][0],)
    assert commands[0].messages["action"][0].linear.x == 0.2
    assert [frame[0, 0, 1] for frame in policy.asked[0]["image"]] == [0, 0, 1]
    assert [frame[0, 0, 1] for frame in policy.asked[3]["image"]] == [2, 3, 4]
    assert [list(asked["past"]) for asked in policy.asked] == [[3, 3, 3], [3, 3, 2], [3, 2, 2], [2, 2, 2]]


def test_new_instruction_resets_the_policy():
    policy = Plays(spec_of((CAMERA, TEXT), SPEEDS), [0.1, 0.0])
    feed = Feed(controller_of(policy))
    assert feed(image=picture()).status == "waiting: no instruction on /task"
    feed(task=String("a"), image=picture())
    feed(image=picture())
    assert policy.resets == 2
    feed(task=String("b"))
    assert policy.resets == 3
    assert feed(task=String(" ")).messages["action"][0].linear.x == 0
    assert [asked["task"] for asked in policy.asked] == ["a", "a", "b"]


def test_text_of_the_map_needs_no_topic():
    policy = Plays(spec_of((CAMERA, TEXT), SPEEDS), [0.1, 0.0])
    values = propose(policy.spec)
    values["inputs"]["task"] = {"text": "tidy up"}
    controller = controller_of(policy, values)
    assert [entry.name for entry in controller.inputs] == ["image"]
    Feed(controller)(image=picture())
    assert policy.asked[0]["task"] == "tidy up"


def test_same_snapshot_same_command():
    """A step changes nothing that another step reads: the state is passed on, not changed."""
    policy = Plays(spec_of((STATE,), SPEEDS), [0.1, 0.0])
    controller = controller_of(policy)
    feed = Feed(controller)
    feed(state=joints([1, 2, 3]))
    before = feed.state
    feed(state=joints([4, 5, 6], at=0.1))
    again = [controller.step(feed.snapshot, before)[0] for _ in range(2)]
    assert again[0].status == again[1].status == "acting policy"
    assert all((asked["state"] == policy.asked[1]["state"]).all() for asked in policy.asked[2:])


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ({"state": joints([1, 2], ("pan", "lift"))}, "without the joint 'grip'"),
        ({"state": joints([1, 2, 3, 4], (*JOINTS, "pan"))}, "2 times with the joint 'pan'"),
        ({"state": joints([1, float("nan"), 3])}, "'state' has a value that is not finite"),
        ({"state": joints([1, 2])}, "3 names and 2 values of position"),
        ({"image": replace(picture(), encoding="weird")}, "encoding"),
        ({"image": replace(picture(), data=np.zeros(3, np.uint8))}, "3 bytes"),
        ({"image": replace(picture(), height=0)}, "0 pixels"),
        ({"image": image_message(np.ones((4, 6), np.float32), "32FC1")}, "no colours"),
    ],
)
def test_bad_messages_stop_the_robot_and_are_named(messages, words):
    policy = Plays(spec_of((CAMERA, STATE), SPEEDS), [1.0, 1.0])
    feed = Feed(controller_of(policy))
    assert feed(image=picture(), state=joints([1, 2, 3])).messages["action"][0].linear.x == 1
    command = feed(**messages)
    assert words in command.status
    assert command.messages["action"][0].linear.x == 0
    assert feed(image=picture(), state=joints([1, 2, 3], at=0.2)).messages["action"][0].linear.x == 1


def test_policy_that_fails_stops_the_robot():
    feed = Feed(controller_of(Plays(spec_of((CAMERA,), SPEEDS), DeadlineMissed("There is no action within 5 ms."))))
    command = feed(image=picture())
    assert command.status == "stopped: There is no action within 5 ms."
    assert command.messages["action"][0].linear.x == 0


@pytest.mark.parametrize(
    ("action", "words"),
    [([0.1, math.nan], "not finite"), ([math.inf, 0.0], "not finite"), ([0.1], "has 1 numbers; 2 are mapped")],
)
def test_an_action_that_commands_no_number_stops_the_robot(action, words):
    command = Feed(controller_of(Plays(spec_of((CAMERA,), SPEEDS), action)))(image=picture())
    assert words in command.status
    assert (command.messages["action"][0].linear.x, command.messages["action"][0].angular.z) == (0.0, 0.0)


@pytest.mark.parametrize("index", [-1, 3, 10**9])
def test_an_action_without_a_label_stops_the_robot(index):
    command = Feed(controller_of(Plays(spec_of((CAMERA,), MOVES), index)))(image=picture())
    assert "has no label" in command.status
    assert command.messages["action"][0].linear.x == 0.0


def arm_by_joint_states(mode):
    """An arm that is commanded by JointStates, of whose joints the policy sees one alone."""
    state = replace(STATE, shape=(1, 1), labels=("pan",), unit=("rad",))
    spec = spec_of((state,), replace(ARM, mode=mode))
    values = propose(spec)
    values["output"]["type"] = JointState.TYPE
    return Feed(controller_of(Plays(spec, [0.0, 0.0, 0.0]), values))


@pytest.mark.parametrize("mode", ["absolute", "delta"])
def test_joints_that_are_at_no_number_are_not_commanded_to_be_there(mode):
    feed = arm_by_joint_states(mode)
    assert "acting" in feed(state=joints([0.1, 0.2, 0.3])).status
    for _ in range(12):
        command = feed(state=joints([0.1, math.nan, 0.3], at=feed.tick / 10))
        assert all(np.isfinite(message.position).all() for message in command.messages["action"])
    if mode == "delta":
        assert "not finite" in command.status


def test_a_stop_commands_no_place_where_the_joints_were_long_ago():
    feed = arm_by_joint_states("absolute")
    feed(state=joints([0.1, 0.2, 0.3]))
    commands = [feed() for _ in range(12)]
    assert commands[-1].status.startswith("waiting: 'state' is 1.2 s old")
    assert commands[-1].messages["action"] == ()


def test_rest_of_each_output():
    arm = controller_of(Plays(spec_of()))
    assert arm.rest().messages["action"][0].points == ()
    base = controller_of(Plays(spec_of((CAMERA,), SPEEDS)))
    assert isinstance(base.rest().messages["action"][0], Twist)
    values = propose(spec_of())
    values["output"]["type"] = JointState.TYPE
    assert controller_of(Plays(spec_of()), values).rest().messages["action"] == ()


def edited(path, value):
    def edit(values):
        *parts, last = path.split("/")
        for part in parts:
            values = values[part]
        if value is None:
            del values[last]
        else:
            values[last] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (edited("inputs/image", None), "does not say which topic is the input 'image'"),
        (edited("inputs/images", {}), "has the input 'images', which the policy does not take; did you mean 'image'"),
        (edited("outputs", {}), "the part 'outputs'; did you mean 'output'"),
        (edited("inputs", []), "The part 'inputs' of the map is []"),
        (edited("output", None), "does not say what the action 'action' commands"),
        (edited("inputs/image/topic", "camera"), "has the topic 'camera'; it begins with a slash"),
        (edited("inputs/image/topic", 5), "has the topic 5"),
        (edited("inputs/image/tpic", "/a"), "has 'tpic'; did you mean 'topic'"),
        (
            edited("inputs/image/type", "std_msgs/msg/String"),
            "has the type 'std_msgs/msg/String'; allowed: sensor_msgs",
        ),
        (edited("inputs/image/type", "acme/msg/X"), "Unknown type of message 'acme/msg/X'"),
        (edited("inputs/image/stale_s", 0), "stale_s is 0; it must be above 0"),
        (edited("inputs/image/stale_s", "x"), "stale_s is 'x'; it must be a number"),
        (edited("inputs/image/noisy", "no"), "noisy is 'no'; it must be true or false"),
        (edited("inputs/task/text", 5), "its text is 5; it must be a text"),
        (edited("inputs/state/elements/pan", None), "does not say what is 'pan'"),
        (edited("inputs/state/elements/wrist", "x"), "has 'wrist', which the policy does not have"),
        (edited("inputs/state/elements", ["pan"]), "they must be a mapping"),
        (edited("inputs/task", "go"), "is 'go'; it must be a mapping"),
        (edited("output/elements/grip", None), "does not say what is 'grip'"),
        (edited("output/elements/grip", "pan"), "commands 'pan' twice"),
        (edited("output/type", None), "has the type None; allowed: trajectory_msgs"),
        (edited("output/type", "geometry_msgs/msg/Twist"), "names 'pan' of a Twist"),
        (edited("output/mode", "relative"), "the mode 'relative'; a JointTrajectory takes absolute, delta, velocity"),
        (edited("output/ignore", "grip"), "they must be a mapping"),
    ],
)
def test_maps_that_do_not_fit_are_refused_by_name(edit, words):
    policy = Plays(spec_of())
    values = propose(policy.spec)
    edit(values)
    with pytest.raises(UsageError) as refused:
        controller_of(policy, values)
    assert words in refused.value.message
    assert refused.value.fix


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        (spec_of((TensorSpec("x", (1, 3, 8, 8)),)), "export the policy with an image: block"),
        (spec_of((STATE,), replace(ARM, unit="furlong")), "'pan' is in 'furlong', whose SI value is unknown"),
        (spec_of((CAMERA,), replace(ARM, mode="delta")), "no input of the map is a JointState"),
    ],
)
def test_specs_that_no_map_fits(spec, words):
    with pytest.raises(UsageError) as refused:
        controller_of(Plays(spec))
    assert words in f"{refused.value}"


def test_ignored_elements_and_scales():
    spec = spec_of((STATE,), replace(ARM, unit=("furlong", "rad", "mm")))
    values = propose(spec)
    values["output"] |= {"scale": {"pan": 201.168}, "ignore": ["grip"]}
    del values["output"]["elements"]["grip"]
    command = Feed(controller_of(Plays(spec, [1.0, 2.0, 3.0]), values))(state=joints([1, 2, 3]))
    assert command.messages["action"][0].points[0].positions == pytest.approx([201.168, 2.0])
    assert command.messages["action"][0].joint_names == ("pan", "lift")


def test_proposal_guesses_what_the_spec_says():
    assert propose(spec_of((CAMERA,), SPEEDS))["output"] == {
        "topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist",
        "elements": {"forward": "linear.x", "turn": "angular.z"},
    }  # fmt: skip
    velocities = TensorSpec("state", (1, 2), unit=("rad", "rad/s"), labels=("a", "b"))
    assert propose(spec_of((velocities,)))["inputs"]["state"]["elements"] == {"a": "a.position", "b": "b.velocity"}
    assert propose(spec_of((PAST, CAMERA), MOVES))["inputs"]["past"] == {"source": "actions"}


def test_without_a_policy():
    assert Policy().rate == 0
    with pytest.raises(UsageError, match="has no policy"):
        _ = Policy().rate_hz
