from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from _full import small_or_full
from _mobile_feed import Feed, depth_image, odometry, speeds, velocity
from _safety_reference import COLUMNS, FENCE, ROWS, TASK_S, Events, Reference, to_messages

from vlatool.controllers._interface import Reading, Request
from vlatool.controllers._safety_table import (
    TABLE,
    Facts,
    Level,
    Rule,
    Status,
    conditions,
    highest,
    next_level,
    release,
)
from vlatool.controllers.safety_monitor import SafetyMonitor
from vlatool.errors import UsageError
from vlatool.messages.sensor_msgs import BatteryState, Image, JointState, LaserScan
from vlatool.messages.std_msgs import Bool, String
from vlatool.messages.std_srvs import SetBoolRequest

KEPT = 2_000
FENCED = ",".join(map(str, FENCE))
FAILURE = "the monitor failed"


class Moment(NamedTuple):
    """A step of random events: what was measured, what was asked of the service, the level of the second model."""

    time: float
    facts: Facts
    calls: list[bool]
    level: int


def compare(steps: int, seed: int) -> list[Moment]:
    """Hold the monitor against the second model on random events; return what the table got at each step."""
    monitor, reference, events, feed = SafetyMonitor(fence=FENCED, task_s=TASK_S), Reference(), Events(seed), Feed()
    state, moments, facts = monitor.start(), [], []
    spy = Rule("no condition", Level.NORMAL, lambda measured, _: bool(facts.append(measured)))
    object.__setattr__(monitor, "_table", (*TABLE, spy))
    for count in range(steps):
        time, event = events.next()
        asked = event.get("calls", [])
        requests = [Request("emergency", SetBoolRequest(data), number) for number, data in enumerate(asked)]
        snapshot = feed.snapshot(time, requests=requests, **to_messages(event))
        command, state = monitor.step(snapshot, state)
        level, linear, angular, answers = reference.step(time, event)
        assert speeds(command, "safe_cmd_vel") == pytest.approx((linear, angular), abs=1e-12), (count, command.status)
        assert state.status.level == level, (count, command.status, events.trouble)
        assert [answer.success for answer in command.responses.values()] == answers
        if steps <= KEPT:
            moments.append(Moment(time, facts[-1], asked, level))
    return moments


@pytest.fixture(scope="module")
def moments() -> list[Moment]:
    return compare(KEPT, seed=1)


def test_random_events_give_the_levels_and_speeds_of_a_second_model(moments: list[Moment]):
    assert {moment.level for moment in moments} == {0, 1, 2, 3}


@pytest.mark.soak("test_random_events_give_the_levels_and_speeds_of_a_second_model: 2,000 steps")
@pytest.mark.parametrize("seed", range(2, 12))
def test_a_million_random_events_give_the_levels_and_speeds_of_a_second_model(seed: int):
    compare(100_000, seed)


@pytest.mark.parametrize("rule", [rule for rule in TABLE if rule.name != FAILURE], ids=lambda rule: rule.name)
def test_without_any_condition_the_levels_differ_from_the_second_model(rule: Rule, moments: list[Moment]):
    limits = SafetyMonitor(fence=FENCED, task_s=TASK_S)._robot.limits

    def levels(table: tuple[Rule, ...]) -> list[int]:
        status, found = Status(), []
        for time, facts, calls, _ in moments:
            demand = highest(conditions(facts, limits, table))
            status = next_level(status, demand, time)
            for wanted in calls:
                status = Status(Level.EMERGENCY) if wanted else release(status, demand, time)
            found.append(int(status.level))
        return found

    expected = [moment.level for moment in moments]
    assert levels(TABLE) == expected
    assert levels(tuple(other for other in TABLE if other is not rule)) != expected


def ready(feed: Feed, time: float, **messages: object) -> dict[str, object]:
    """Return sensors that see nothing, anew, and further messages."""
    random = np.random.default_rng(round(time * 1000))
    ranges = random.uniform(3, 3.1, 360).astype(np.float32)
    scan = LaserScan(odometry(0, 0, 0, time).header, -math.pi, math.pi, math.pi / 180, 0, 0.1, 0.1, 12, ranges)
    depth = depth_image(random.uniform(3, 3.1, (12, 16)), time)
    return {"scan": scan, "depth": depth, "odometry": odometry(0.0, 0.0, 0.0, time), **messages}


def test_a_failure_of_the_monitor_is_an_emergency_and_stays_one():
    feed, monitor = Feed(), SafetyMonitor()
    command, state = monitor.step(feed.snapshot(0.0, **ready(feed, 0.0, cmd_vel=velocity(0.2))), monitor.start())
    assert speeds(command, "safe_cmd_vel") == (0.2, 0.0)
    broken = ready(feed, 0.1, cmd_vel=velocity(0.2))
    object.__setattr__(broken["scan"], "ranges", "not an array")
    command, state = monitor.step(feed.snapshot(0.1, **broken), state)
    assert state.status.level is Level.EMERGENCY
    assert command.status.startswith(f"EMERGENCY {FAILURE} (")
    assert speeds(command, "safe_cmd_vel") == (0.0, 0.0)
    command, state = monitor.step(feed.snapshot(9.0, **ready(feed, 9.0, cmd_vel=velocity(0.2))), state)
    assert speeds(command, "safe_cmd_vel") == (0.0, 0.0)


def test_an_obstacle_stops_the_robot_at_the_step_at_which_it_is_seen_and_by_direction_of_travel():
    ahead, behind = 90, 270  # the lidar of a TurtleBot 4 is turned by 90 degrees to the left
    for linear, side, stops in (
        (0.2, ahead, True),
        (-0.2, ahead, False),
        (-0.2, behind, True),
        (0.2, behind, False),
        (0.2, 0, False),
        (0.2, 180, False),
        (0.0, ahead, False),
    ):
        feed, monitor = Feed(), SafetyMonitor()
        messages = ready(feed, 0.0, cmd_vel=velocity(linear))
        messages["scan"].ranges[side] = 0.3
        command, state = monitor.step(feed.snapshot(0.0, **messages), monitor.start())
        assert (state.status.level is Level.EMERGENCY) == stops
        assert speeds(command, "safe_cmd_vel")[0] == (0.0 if stops else linear)


def test_levels_leave_their_share_and_fall_one_step_a_second_emergency_only_by_its_service():
    feed, monitor, seen = Feed(), SafetyMonitor(), []
    state = monitor.start()
    for tick in range(120):
        time, requests = tick * 0.05, []
        if tick == 60:
            requests = [Request("emergency", SetBoolRequest(False), 7)]
        messages = ready(feed, time, cmd_vel=velocity(0.2), emergency_stop=Bool(tick < 10))
        command, state = monitor.step(feed.snapshot(time, requests=requests, **messages), state)
        seen.append(round(speeds(command, "safe_cmd_vel")[0], 6))
    assert seen[:60] == [0.0] * 60
    assert seen[60:] == [0.04] * 20 + [0.1] * 20 + [0.2] * 20


def test_a_monitor_that_holds_at_its_start_passes_nothing_on_until_it_is_released():
    feed, monitor = Feed(), SafetyMonitor(hold_at_start=True)
    (linear, _, status), state = passed_on(feed, monitor, monitor.start(), 0.0)
    assert (linear, status) == (0.0, "EMERGENCY")
    messages = ready(feed, 0.1, cmd_vel=velocity(0.2))
    requests = [Request("emergency", SetBoolRequest(False), 1)]
    command, state = monitor.step(feed.snapshot(0.1, requests=requests, **messages), state)
    assert command.responses[1].success
    assert speeds(command, "safe_cmd_vel")[0] == pytest.approx(0.04)


def test_emergency_is_not_released_while_its_condition_holds_and_the_answer_names_it():
    feed, monitor = Feed(), SafetyMonitor()
    stopped = ready(feed, 0.0, emergency_stop=Bool(True))
    requests = [Request("emergency", SetBoolRequest(False), 3)]
    command, state = monitor.step(feed.snapshot(0.0, requests=requests, **stopped), monitor.start())
    assert not command.responses[3].success
    assert command.responses[3].message == "EMERGENCY stays: emergency stop pressed"
    assert state.status.level is Level.EMERGENCY


def test_nothing_moves_before_each_sensor_has_come_or_half_a_second_after_the_last_command():
    feed, monitor = Feed(), SafetyMonitor()
    command, state = monitor.step(feed.snapshot(0.0, cmd_vel=velocity(0.2)), monitor.start())
    assert speeds(command, "safe_cmd_vel") == (0.0, 0.0)
    assert "waiting for scan, depth, odometry" in command.status
    feed, state, moved = Feed(), monitor.start(), []
    for tick in range(12):
        messages = ready(feed, tick * 0.1, **({"cmd_vel": velocity(0.2)} if tick == 0 else {}))
        command, state = monitor.step(feed.snapshot(tick * 0.1, **messages), state)
        moved.append(speeds(command, "safe_cmd_vel")[0] > 0)
    assert moved == [True] * 6 + [False] * 6


def test_hostile_messages_never_raise():
    random, feed, monitor = np.random.default_rng(5), Feed(), SafetyMonitor()
    state = monitor.start()
    encodings = ("32FC1", "16UC1", "rgb8", "nonsense", "")
    for count in range(small_or_full(300, 20_000)):
        data = random.integers(0, 256, int(random.integers(0, 4 * ROWS * COLUMNS + 1))).astype(np.uint8)
        image = Image(height=ROWS, width=COLUMNS, encoding=str(random.choice(encodings)), step=4 * COLUMNS, data=data)
        values = random.choice([math.nan, math.inf, -math.inf, 0.0, 1e30, -1.0], (8, 1))
        scan = LaserScan(angle_increment=float(values[0, 0]), range_max=12.0, ranges=values[:, 0].astype(np.float32))
        command, state = monitor.step(
            feed.snapshot(count * 0.05, depth=image, scan=scan, cmd_vel=velocity(*values[:2, 0]),
                          odometry=odometry(*values[2:4, 0], 0.0)), state
        )  # fmt: skip
        assert all(map(math.isfinite, speeds(command, "safe_cmd_vel")))


def passed_on(feed: Feed, monitor: SafetyMonitor, state: Any, time: float, **messages: object) -> tuple[Any, Any]:
    """Return speeds and status, and the state, after a step with sensors that see nothing and further messages."""
    snapshot = feed.snapshot(time, **ready(feed, time, **{"cmd_vel": velocity(0.2), **messages}))
    command, state = monitor.step(snapshot, state)
    return (*speeds(command, "safe_cmd_vel"), command.status), state


def test_the_way_that_is_looked_at_is_that_of_the_speeds_that_are_passed_on():
    feed, monitor = Feed(), SafetyMonitor()
    messages = ready(feed, 0.0, cmd_vel=velocity(0.3, 300.0))
    messages["scan"].ranges[90 + 35 : 90 + 70] = 0.3  # to the left, where an arc of 0.3 m/s and 1.9 rad/s leads
    command, state = monitor.step(feed.snapshot(0.0, **messages), monitor.start())
    assert state.status.level is Level.EMERGENCY
    assert speeds(command, "safe_cmd_vel") == (0.0, 0.0)


@pytest.mark.parametrize("limits", [{"range_max": 0.0}, {"range_max": -1.0}, {"range_max": 0.05}, {"range_min": 99.0}])
def test_a_scan_whose_limits_leave_no_range_sees_nothing_rather_than_free_space(limits: dict[str, float]):
    feed, monitor = Feed(), SafetyMonitor()
    scan = ready(feed, 0.0)["scan"]
    (*_, status), _ = passed_on(feed, monitor, monitor.start(), 0.0, scan=dataclasses.replace(scan, **limits))
    assert status == "CRITICAL sensor out"


def test_a_scan_of_too_few_rays_is_out():
    feed, monitor = Feed(), SafetyMonitor()
    scan = ready(feed, 0.0)["scan"]
    thin = dataclasses.replace(scan, angle_min=-math.pi / 2, ranges=np.full(1, 3.0, np.float32))
    (*_, status), _ = passed_on(feed, monitor, monitor.start(), 0.0, scan=thin)
    assert status == "CRITICAL sensor out"


@pytest.mark.parametrize(
    ("charge", "level"), [(1.0, "NORMAL"), (80.0, "WARNING battery low"), (4.0, "WARNING battery low")]
)
def test_a_charge_in_percent_is_seen_at_once(charge: float, level: str):
    feed, monitor = Feed(), SafetyMonitor()
    (*_, status), _ = passed_on(feed, monitor, monitor.start(), 0.0, battery=BatteryState(percentage=charge))
    assert status == level


@pytest.mark.parametrize("efforts", [[math.nan, 9.0], [9.0, math.nan]])
def test_a_current_that_is_unknown_hides_no_other(efforts: list[float]):
    feed, monitor = Feed(), SafetyMonitor()
    joints = JointState(effort=np.array(efforts))
    (*_, status), _ = passed_on(feed, monitor, monitor.start(), 0.0, joints=joints)
    assert status == "EMERGENCY motor current high, motor current very high"


@pytest.mark.parametrize(
    ("name", "value", "calm", "level"),
    [("emergency_stop", Bool(True), Bool(False), "EMERGENCY"), ("person", Bool(True), Bool(False), "CRITICAL"),
     ("task", String("flying"), String("running"), "CRITICAL")],
)  # fmt: skip
def test_a_word_of_danger_counts_though_a_newer_one_of_the_same_step_says_otherwise(
    name: str, value: Any, calm: Any, level: str
):
    feed, monitor = Feed(), SafetyMonitor()
    depth = next(entry.depth for entry in monitor.inputs if entry.name == name)
    snapshot = feed.snapshot(0.0, **ready(feed, 0.0, cmd_vel=velocity(0.2), **{name: calm}))
    several = tuple(Reading(message, 0.0, count) for count, message in enumerate((value, *[calm] * 40)[-depth:]))
    snapshot = dataclasses.replace(snapshot, readings={**snapshot.readings, name: several})
    command, _ = monitor.step(snapshot, monitor.start())
    assert command.status.startswith(level)


def test_a_detector_that_is_expected_is_out_when_it_falls_silent():
    feed, monitor = Feed(), SafetyMonitor(expects="scan,depth,odometry,person")
    (linear, _, status), state = passed_on(feed, monitor, monitor.start(), 0.0)
    assert (linear, status) == (0.0, "CRITICAL waiting for person, sensor out")
    seen = []
    for tick in range(40):
        person = {"person": Bool(False)} if tick < 30 else {}
        (linear, _, status), state = passed_on(feed, monitor, state, 0.1 + tick * 0.1, **person)
        seen.append(status)
    assert seen[28:30] == ["NORMAL"] * 2
    assert seen[-1] == "CRITICAL sensor out"


def test_the_fence_comes_nearer_while_nobody_knows_where_the_robot_is():
    feed, monitor = Feed(), SafetyMonitor(fence="-1,-1,1,1")
    state, seen = monitor.start(), []
    for tick in range(50):
        pose = odometry(math.nan if tick else 0.0, 0.0, 0.0, tick * 0.1)
        (*_, status), state = passed_on(feed, monitor, state, tick * 0.1, odometry=pose)
        seen.append(status.split()[0])
    assert seen[1] == "CRITICAL"
    assert seen[30] == "CRITICAL"
    assert seen[40] == "EMERGENCY"  # 0.306 m/s for 3.3 s are more than a metre


@pytest.mark.parametrize(
    "settings",
    [
        {"fence": "1,2,3"}, {"fence": "3,3,1,1"}, {"critical_m": 0.1}, {"expects": "radar"}, {"rate": -1.0},
        {"fence": "-1,-1,1,1", "expects": "scan"}, {"max_linear_speed": -1.0}, {"max_linear_speed": 0.0},
        {"max_angular_speed": 1e9}, {"max_age_s": 1e9}, {"max_age_s": 0.0}, {"command_s": 1e9}, {"silence_s": 1e9},
        {"silence_s": -1.0}, {"emergency_m": 0.0}, {"warning_m": 9.0}, {"radius_m": 0.0}, {"top_m": 0.0},
        {"cliff_m": 99.0}, {"cliff_m": 0.0}, {"camera_hfov_deg": 0.0}, {"camera_hfov_deg": -69.0},
        {"camera_hfov_deg": 360.0}, {"battery_emergency": -1.0}, {"battery_warning": 0.01},
        {"current_critical_a": -1.0}, {"current_critical_a": 7.0}, {"task_s": -1.0}, {"fence_warning_m": -1.0},
        {"camera_forward_m": -50.0}, {"camera_height_m": 0.0}, {"scan_forward_m": 50.0}, {"scan_yaw_deg": 999.0},
        {"rate": 0.01},
    ],
    ids=str,
)  # fmt: skip
def test_settings_out_of_range_are_refused(settings: dict[str, object]):
    with pytest.raises(UsageError) as caught:
        SafetyMonitor(**settings)
    assert caught.value.fix
