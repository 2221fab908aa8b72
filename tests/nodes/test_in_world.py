"""Controllers in a world: one clock, chains, events, the same bytes for the same seed."""

from __future__ import annotations

import pytest

from tests._point_robot import GoTo, Limiter, PointWorld
from vlatool.errors import UsageError
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.std_msgs import Bool, String
from vlatool.nodes.in_world import Event, Node, Simulation, play

CHAIN = {"obeys": {"/cmd_vel": "/safe_cmd_vel"}}


def test_drives_to_its_goal():
    run = play(PointWorld(noise=0.0), [GoTo()], seconds=10)
    assert run.truths[-1][1] == pytest.approx({"x": 1.0, "y": 0.5}, abs=0.02)
    assert len(run.steps[0]) == 100
    assert [report.snapshot.time_s for report in run.steps[0]] == [number / 10 for number in range(100)]
    assert run.steps[0][0].command.status == "going"  # odometry came with the reset
    assert run.steps[0][5].snapshot.stamp.seconds == pytest.approx(0.5)


def test_same_seed_same_bytes():
    runs = [play(PointWorld(), [GoTo(), Limiter()], seconds=5, seed=seed, **CHAIN) for seed in (7, 7, 8)]
    assert runs[0].checksum == runs[1].checksum != runs[2].checksum
    assert runs[0].truths == runs[1].truths


def test_chain_moves_at_half_the_speed():
    alone, chain = (
        play(PointWorld(noise=0.0), nodes, seconds=1, **options)
        for nodes, options in (([GoTo()], {}), ([GoTo(), Limiter()], CHAIN))
    )
    assert chain.truths[-1][1]["x"] == pytest.approx(alone.truths[-1][1]["x"] / 2, rel=0.1)
    assert [len(steps) for steps in chain.steps] == [10, 20]
    first = chain.steps[1][0].snapshot.message("cmd_in", Twist)
    assert first is chain.steps[0][0].command.messages["cmd"][0]


def test_delay_of_a_computation():
    prompt, late = (play(PointWorld(noise=0.0), [Node(GoTo(), {}, delay)], seconds=2) for delay in (0.0, 0.15))
    moved = [next(time for time, truth in run.truths if truth["x"] > 1e-6) for run in (prompt, late)]
    assert moved[1] >= moved[0] + 0.1


def test_ends_when_the_world_says_so():
    run = play(PointWorld(noise=0.0), [GoTo()], seconds=100, until=lambda truth: truth["x"] > 0.9)
    assert run.seconds < 10


def test_events_and_services():
    events = [Event(1.0, "/halt", Bool(True), call=True), Event(0.35, "/instruction", String("go"))]
    simulation = Simulation(PointWorld(), [GoTo()], events=events)
    run = simulation.play(2)
    statuses = [report.command.status for report in run.steps[0]]
    assert statuses == ["going"] * 10 + ["halted"] * 10
    assert run.steps[0][4].snapshot.readings["instruction"][0].received_s == 0.35
    assert run.steps[0][-1].command.notes == {}


def test_rest_reaches_the_world():
    world = PointWorld(noise=0.0)
    play(world, [GoTo(goal_x=50)], seconds=1)
    before = world.truth()
    world.advance(0.3)
    assert world.truth() == before


def test_two_types_on_a_topic_are_refused():
    with pytest.raises(UsageError, match="/odom carries nav_msgs/msg/Odometry; the controller's 'instruction' is"):
        Simulation(PointWorld(), [Node(GoTo(), {"instruction": "/odom"})])
