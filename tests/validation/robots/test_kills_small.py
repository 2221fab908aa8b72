"""The small form of ``mobile_kills.py``: each process is killed twice while the base drives; and how it judges."""

from __future__ import annotations

import argparse
import ctypes.util
from pathlib import Path

import pytest
from _killed_nodes import State, last_rest
from mobile_kills import LIMIT_S, WHAT, Kill, run, table

TICK_S = 0.01


def states(*speeds: float) -> list[State]:
    """States at these speeds forward, one for each tick of 10 ms."""
    found, x = [], 0.0
    for tick, speed in enumerate(speeds):
        found.append(State(100.0 + tick * TICK_S, tick * TICK_S, speed, 0.0, x, 0.0))
        x += speed * TICK_S
    return found


def test_the_rest_of_a_base_is_its_last_standstill_and_one_that_moves_again_does_not_rest():
    rest = last_rest(states(0.3, 0.2, 0.1, 0.0, 0.0, 0.0))
    assert rest is not None
    assert (rest.began_s, rest.simulated_s, rest.lasted_s) == pytest.approx((100.03, 0.03, 0.02))
    assert (rest.way_m, rest.moved_m) == pytest.approx((0.006, 0.0))
    again = last_rest(states(0.3, 0.0, 0.0, 0.1, 0.0))
    assert again is not None
    assert (again.began_s, again.lasted_s) == pytest.approx((100.04, 0.0))
    assert last_rest(states(0.3, 0.0, 0.0, 0.1)) is None


def test_a_base_that_turns_does_not_rest_and_one_that_is_pushed_moves():
    turning = [state._replace(angular=0.02) for state in states(0.3, 0.0, 0.0)]
    assert last_rest(turning) is None
    pushed = states(0.3, 0.0, 0.0)
    rest = last_rest([*pushed[:2], pushed[2]._replace(y=0.05)])
    assert rest is not None
    assert rest.moved_m == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("stood_s", "simulated_s", "lag_s", "decides"),
    [(0.9, 0.9, 0.0, True), (1.3, 1.3, 0.0, True), (1.1, 0.8, 0.3, True), (1.4, 1.3, 0.1, True),
     (1.5, 1.3, 0.2, True), (1.5, 0.8, 0.7, False)],
)  # fmt: skip
def test_only_a_standstill_that_is_late_for_the_processor_alone_decides_nothing(
    stood_s: float, simulated_s: float, lag_s: float, decides: bool
):
    kill = Kill("bus", 0.3, 0.0, stood_s=stood_s, simulated_s=simulated_s, lag_s=lag_s)
    assert kill.decides == decides


@pytest.mark.soak(
    "test_it_is_a_world_that_drives_by_its_command_and_stops_half_a_second_after_the_last and "
    "test_nothing_moves_before_each_sensor_has_come_or_half_a_second_after_the_last_command: the same in one process"
)
@pytest.mark.skipif(
    not any(map(ctypes.util.find_library, ("EGL", "OSMesa"))),
    reason="neither EGL nor OSMesa is installed: nothing renders",
)
@pytest.mark.parametrize("bus", ["zenoh-client", "zenoh", "dds"])
def test_the_base_stands_within_1200_ms_of_a_kill(bus: str, tmp_path: Path):
    what = [each for each in WHAT if each != "bus" or bus != "dds"]
    options = argparse.Namespace(
        bus=bus, what=what, kills=2, robots=1, controller="roi-follower", seed=0, folder=tmp_path,
        ros1=tmp_path, output=None,
    )  # fmt: skip
    kills = [kill for kill in run(options) if kill.decides]
    assert not [kill.problem for kill in kills if kill.problem], table(bus, kills)
    assert len(kills) == options.kills * len(what)
    assert any(kill.drove_on for kill in kills) == (bus == "zenoh")
    assert all(0.1 < (kill.stood_s or 0.0) <= LIMIT_S for kill in kills if kill.what != "bus" or bus != "zenoh")
