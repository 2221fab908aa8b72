from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from _mobile_feed import Feed, depth_image, header, odometry, speeds

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.controllers import Snapshot
from vlatool.controllers.vln import Vln
from vlatool.errors import UsageError
from vlatool.messages.pixels import image_message
from vlatool.messages.std_msgs import Bool, String

LABELS = ("turn left", "TURN_RIGHT", "move-forward", "stop")
LEFT, RIGHT, FORWARD, STOP = range(4)
FRAMES = TensorSpec("image", (1, 2, 6, 8, 3), "uint8")
PAST = TensorSpec("actions", (1, 3), "int64")
TEXT = TensorSpec("instruction", (1, 4), "int64", kind="text", tokenizer="words.json", max_tokens=4)


def spec(*inputs: TensorSpec, labels: tuple[str, ...] = LABELS, kind: str = "discrete") -> PolicySpec:
    action = TensorSpec("logits", (1, len(labels)), kind=kind, labels=labels)
    return PolicySpec(inputs or (FRAMES, PAST, TEXT), (action,), 5.0)


class Route:
    """A policy that knows its actions beforehand, and keeps what it saw."""

    def __init__(self, *actions: int, spec: PolicySpec | None = None) -> None:
        self.spec, self.actions, self.seen, self.resets = spec or globals()["spec"](), list(actions), [], 0

    def reset(self, seed: int | None = None) -> None:
        self.resets += 1

    def infer(self, observation: Any) -> Any:
        self.seen.append(observation)
        return SimpleNamespace(chunk=np.array([self.actions.pop(0)]))


class Drive:
    """A base without mass that goes where it is told, and its sensors; what it reports can be held back."""

    def __init__(self, controller: Vln, ahead: float = 9.0) -> None:
        self.controller, self.state, self.feed = controller, controller.start(), Feed()
        self.time, self.pose, self.ahead = 0.0, [0.0, 0.0, 0.0], ahead
        self.statuses: list[str] = []

    def run(
        self, seconds: float, *, camera: bool = True, odom: bool = True, depth: bool = True, **messages: Any
    ) -> None:
        for _ in range(round(seconds * 10)):
            if camera:
                pixels = np.full((6, 8, 3), int(self.time * 10) % 256, np.uint8)
                messages["image"] = image_message(pixels, "rgb8", header(self.time))
            if odom:
                messages["odometry"] = odometry(*self.pose, stamp_s=self.time)
            if depth:
                messages["depth"] = depth_image(np.full((8, 8), self.ahead, np.float32), self.time)
            command, self.state = self.controller.step(self.feed.snapshot(self.time, **messages), self.state)
            messages = {}
            self.statuses.append(command.status)
            self.command = command
            linear, angular = speeds(command)
            self.pose[2] += angular * 0.1
            self.pose[0] += linear * 0.1 * math.cos(self.pose[2])
            self.pose[1] += linear * 0.1 * math.sin(self.pose[2])
            self.time += 0.1


class HeavyDrive(Drive):
    """A base that takes half a second to stop, and says so; its camera is 200 ms late."""

    def __init__(self, controller: Vln, depth_ticks: int = 0) -> None:
        super().__init__(controller)
        self.linear, self.speeds, self.frames = 0.0, [], []
        self.depth_ticks, self.depths = depth_ticks, []

    def run(self, seconds: float, *, camera: bool = True, **messages: Any) -> None:
        for _ in range(round(seconds * 10)):
            tick = len(self.speeds)
            self.speeds.append(self.linear)
            pixels = np.full((6, 8, 3), tick, np.uint8)
            self.frames.append(image_message(pixels, "rgb8", header(tick / 10)))
            if tick >= 2 and camera:
                messages["image"] = self.frames[tick - 2]
            messages["odometry"] = odometry(*self.pose, stamp_s=tick / 10, linear=self.linear)
            self.depths.append(depth_image(np.full((8, 8), self.ahead, np.float32), tick / 10))
            if tick >= self.depth_ticks:
                messages["depth"] = self.depths[tick - self.depth_ticks]
            command, self.state = self.controller.step(self.feed.snapshot(tick / 10, **messages), self.state)
            messages = {}
            self.linear += max(-0.06, min(0.06, speeds(command)[0] - self.linear))
            self.pose[0] += self.linear * 0.1


def newest_frames(policy: Route) -> list[int]:
    """Return at which tick of ``HeavyDrive`` the newest frame of each observation was taken."""
    return [int(seen["image"][-1].max()) for seen in policy.seen]


def test_labels_become_motions_that_odometry_ends_and_it_stops_by_its_stop_label():
    policy = Route(LEFT, FORWARD, RIGHT, STOP)
    drive = Drive(Vln(policy=policy, forward_m=0.5))
    drive.run(0.1, instruction=String("go to the door"))
    drive.run(20.0)
    assert drive.pose == pytest.approx([0.0, 0.5, 0.0], abs=0.04)
    assert drive.state.phase == "arrived"
    assert drive.statuses[-1] == "arrived by its stop label"
    assert speeds(drive.command) == (0.0, 0.0)
    assert drive.state.actions == (LEFT, FORWARD, RIGHT, STOP)


def test_the_policy_sees_the_instruction_its_past_actions_and_frames_that_were_taken_after_a_motion():
    policy = Route(LEFT, FORWARD, STOP)
    drive = Drive(Vln(policy=policy, forward_m=0.5))
    drive.run(0.1, instruction=String("go to the door"))
    drive.run(15.0)
    first, second, third = policy.seen
    assert first["instruction"] == "go to the door"
    assert first["actions"].tolist() == [4, 4, 4]
    assert third["actions"].tolist() == [4, LEFT, FORWARD]
    assert first["image"].shape == (2, 6, 8, 3)
    assert not first["image"][0].any()
    assert np.array_equal(second["image"][0], first["image"][1])
    assert third["image"][1].max() > second["image"][1].max() > first["image"][1].max()


@pytest.mark.parametrize("change", ["another instruction", "something in the way"])
def test_a_motion_that_is_broken_off_is_over_when_the_robot_stands_and_the_next_frame_is_later(change: str):
    policy = Route(FORWARD, STOP)
    drive = HeavyDrive(Vln(policy=policy))
    drive.run(0.1, instruction=String("go"))
    drive.run(2.0)
    moment = len(drive.speeds)
    assert drive.linear == pytest.approx(0.3)
    if change == "another instruction":
        drive.run(0.1, instruction=String("come"))
    else:
        drive.ahead = 0.2
    drive.run(3.0)
    before, after = newest_frames(policy)
    assert drive.speeds[before] == 0.0
    assert after > moment
    assert drive.speeds[after] == pytest.approx(0.0, abs=0.02)
    assert drive.state.phase == "arrived"


def test_the_first_frame_of_an_instruction_was_taken_after_it_came():
    policy = Route(STOP, STOP)
    drive = HeavyDrive(Vln(policy=policy))
    drive.run(0.1, instruction=String("go"))
    drive.run(2.0)
    moment = len(drive.speeds)
    drive.run(0.1, instruction=String("come"))
    drive.run(1.0)
    assert newest_frames(policy)[1] > moment


def test_a_depth_image_of_before_the_turn_does_not_say_that_the_way_is_free():
    policy = Route(LEFT, FORWARD, STOP)
    drive = HeavyDrive(Vln(policy=policy), depth_ticks=4)
    drive.run(0.1, instruction=String("go"))
    drive.run(2.0)
    drive.pose[2], drive.ahead = math.pi / 2, 0.6
    drive.run(5.0)
    assert drive.state.actions == (LEFT, FORWARD, STOP)
    assert max(drive.speeds) == 0.0


def test_odometry_whose_speed_is_never_zero_delays_a_decision_until_a_frame_that_came_a_second_later():
    policy = Route(STOP)
    drive = HeavyDrive(Vln(policy=policy))
    for tick in range(20):
        drive.linear = 0.1
        drive.run(0.1, camera=not 8 <= tick < 12, **({} if tick else {"instruction": String("go")}))
    assert drive.state.phase == "arrived"
    assert newest_frames(policy) == [10]


def test_it_does_not_choose_before_the_word_on_arrival_that_was_sent_after_the_frame():
    policy = Route(LEFT, LEFT, LEFT, LEFT)
    drive = Drive(Vln(policy=policy))
    drive.run(0.1, instruction=String("go"), arrived=Bool(False))
    drive.run(0.1)
    drive.run(0.1, arrived=Bool(True))
    assert drive.state.phase == "arrived"
    assert not policy.seen
    drive.run(0.1, instruction=String("go on"), arrived=Bool(False))
    drive.run(0.1, arrived=Bool(False))
    assert len(policy.seen) == 1


def test_words_on_arrival_that_come_just_before_each_frame_do_not_hold_it_up_for_ever():
    policy = Route(LEFT, STOP)
    drive = Drive(Vln(policy=policy))
    snapshot_of = drive.feed.snapshot

    def snapshot(time_s: float, **messages: Any) -> Snapshot:
        found = snapshot_of(time_s, **messages)
        word = found.newest["arrived"]._replace(received_s=time_s - 0.01)
        return replace(found, newest={**found.newest, "arrived": word}, readings={**found.readings, "arrived": (word,)})

    drive.feed.snapshot = snapshot
    for tick in range(4):
        drive.run(0.1, arrived=Bool(False), **({} if tick else {"instruction": String("go")}))
    assert len(policy.seen) == 1


def test_a_word_on_arrival_that_does_not_come_again_is_not_waited_for():
    policy = Route(LEFT, STOP)
    drive = Drive(Vln(policy=policy))
    drive.run(0.1, instruction=String("go"), arrived=Bool(False))
    drive.run(0.7)
    assert len(policy.seen) == 1


def test_it_never_moves_without_an_instruction_and_an_empty_one_ends_it():
    policy = Route(FORWARD, FORWARD)
    drive = Drive(Vln(policy=policy))
    drive.run(3.0)
    assert drive.pose == [0.0, 0.0, 0.0]
    assert not policy.seen
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    assert speeds(drive.command)[0] > 0
    drive.run(0.1, instruction=String("  "))
    assert speeds(drive.command) == (0.0, 0.0)
    assert drive.state.phase == "idle"


@pytest.mark.parametrize("absent", ["camera", "odom", "depth"])
def test_it_stands_while_a_sensor_is_old_and_goes_on_afterwards(absent: str):
    drive = Drive(Vln(policy=Route(FORWARD, STOP)))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    assert speeds(drive.command)[0] > 0
    drive.run(0.7, **{absent: False})
    assert speeds(drive.command) == (0.0, 0.0)
    assert drive.statuses[-1].startswith("paused")
    assert "s old" in drive.statuses[-1]
    drive.run(10.0)
    assert drive.state.phase == "arrived"


def test_a_camera_that_repeats_its_stamp_is_old_and_a_clock_that_was_set_is_not():
    drive = Drive(Vln(policy=Route(FORWARD, STOP)))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    frozen = drive.feed.newest["image"].message
    for _ in range(8):
        drive.run(0.1, camera=False, image=frozen)
    assert drive.statuses[-1].startswith("paused camera")
    hour = Drive(Vln(policy=Route(FORWARD, STOP)))
    hour.feed.snapshot = lambda time, **messages: Feed.snapshot(hour.feed, time, stamp_s=time + 3600.0, **messages)
    hour.run(0.1, instruction=String("go"))
    hour.run(10.0)
    assert hour.state.phase == "arrived"


def test_a_step_forward_is_not_driven_into_what_depth_sees_and_the_policy_is_asked_again():
    policy = Route(FORWARD, LEFT, STOP)
    drive = Drive(Vln(policy=policy, forward_m=0.5), ahead=0.7)
    drive.run(0.1, instruction=String("go"))
    drive.run(10.0)
    assert drive.pose[:2] == pytest.approx([0.0, 0.0])
    assert policy.seen[1]["actions"].tolist() == [4, 4, FORWARD]


def test_it_stops_when_it_is_told_that_it_arrived_and_gives_up_after_its_actions():
    drive = Drive(Vln(policy=Route(FORWARD, FORWARD)))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    drive.run(0.1, arrived=Bool(True))
    assert drive.state.phase == "arrived"
    assert speeds(drive.command) == (0.0, 0.0)
    drive = Drive(Vln(policy=Route(LEFT, LEFT, LEFT), max_actions=2))
    drive.run(0.1, instruction=String("go"))
    drive.run(20.0)
    assert drive.statuses[-1] == "failed no arrival in 2 actions"


@pytest.mark.parametrize("camera", [False, True])
def test_a_word_on_arrival_while_it_is_paused_ends_the_task_once_it_runs_again(camera: bool):
    policy = Route(FORWARD, LEFT)
    drive = Drive(Vln(policy=policy))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    drive.run(0.7, camera=False)
    assert drive.state.phase == "paused"
    drive.run(0.1, camera=camera, arrived=Bool(True))
    drive.run(0.5)
    assert len(policy.seen) == 1
    words = [status.partition(" ")[0] for status in drive.statuses]
    assert list(dict.fromkeys(words[words.index("paused") :])) == ["paused", "running", "arrived"]
    assert speeds(drive.command) == (0.0, 0.0)


def test_a_jump_of_the_odometry_ends_a_step_instead_of_making_it_longer():
    drive = Drive(Vln(policy=Route(FORWARD, STOP)))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    assert speeds(drive.command)[0] > 0
    drive.pose[0] -= 5.0
    before = drive.pose[0]
    drive.run(10.0)
    assert drive.pose[0] - before < 0.1
    assert any("odometry jumped" in status for status in drive.statuses)


def test_a_new_instruction_resets_the_policy_and_begins_again():
    policy = Route(LEFT, LEFT, STOP)
    drive = Drive(Vln(policy=policy))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    resets = policy.resets
    drive.run(0.1, instruction=String("come"))
    assert policy.resets == resets + 1
    drive.run(10.0)
    assert policy.seen[-1]["instruction"] == "come"
    assert drive.state.actions == (LEFT, STOP)


def test_a_policy_that_fails_or_an_image_of_another_size_ends_in_standing():
    drive = Drive(Vln(policy=Route(7)))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    assert drive.statuses[-1] == "failed the policy chose an action without a label"
    drive = Drive(Vln(policy=Route(0, spec=spec(TensorSpec("image", (1, 4, 4, 3), "uint8")))))
    drive.run(0.1, instruction=String("go"))
    drive.run(1.0)
    assert drive.statuses[-1].startswith("failed The frames of the camera are (6, 8, 3)")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"labels": ("left", "dance")}, "asks for no motion"),
        ({"labels": ("left", "stop right")}, "asks for right and stop"),
        ({"kind": "tensor"}, "allowed: discrete"),
    ],
)
def test_a_policy_that_does_not_choose_between_motions_is_refused(changes: dict[str, Any], words: str):
    with pytest.raises(UsageError, match=words):
        Vln(policy=Route(spec=spec(**changes)))


def test_labels_that_say_nothing_are_mapped_by_a_setting():
    drive = Drive(Vln(policy=Route(1, 0, spec=spec(labels=("a", "b"))), motions="a=stop, b=left"))
    drive.run(0.1, instruction=String("go"))
    drive.run(5.0)
    assert drive.pose[2] == pytest.approx(math.pi / 2, abs=0.03)
    with pytest.raises(UsageError, match="no label 'c'"):
        Vln(policy=Route(spec=spec()), motions="c=stop")
    with pytest.raises(UsageError, match="Unknown motion 'fly'"):
        Vln(policy=Route(spec=spec(labels=("a", "b"))), motions="a=fly,b=stop")


@pytest.mark.parametrize(
    "settings", [{"forward_m": 0.0}, {"max_linear_speed": 1.0}, {"turn_deg": math.nan}, {"rate": 0}]
)
def test_settings_out_of_range_are_refused(settings: dict[str, float]):
    with pytest.raises(UsageError, match="allowed"):
        Vln(**settings)


def test_without_a_policy_it_does_not_start():
    with pytest.raises(UsageError, match="no policy"):
        Vln().start()
