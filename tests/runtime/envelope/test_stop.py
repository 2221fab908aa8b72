"""The closed form of a stop against its own samples, and against Ruckig where that is installed."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest

from vlatool.runtime.envelope import Envelope, JointLimits, RobotLimits
from vlatool.runtime.envelope.axis import PositionAxis
from vlatool.runtime.envelope.stop import stop_phases, stop_positions, stop_range, stop_state

LIMITS = ((2.0, 8.0), (15.0, 7500.0), (1.0, 100.0), (5.0, 3.0))


def starts(number: int) -> list[tuple[float, float, float, float]]:
    """Velocity, acceleration and their limits."""
    draw = random.Random(0)
    found = []
    for _ in range(number):
        most, jerk = draw.choice(LIMITS)
        found.append((draw.uniform(-2, 2), draw.choice([0.0, most, -most, draw.uniform(-most, most)]), most, jerk))
    return found


def test_a_stop_is_legal_ends_at_rest_and_stays_in_its_range():
    for velocity, acceleration, most, jerk in starts(150):
        phases = stop_phases(velocity, acceleration, most, jerk)
        end = sum(phases[:3])
        times = np.linspace(0, end, 201)
        states = np.array([stop_state(0.0, velocity, acceleration, phases, time) for time in times])
        low, high, slow, fast = stop_range(velocity, acceleration, most, jerk)
        assert abs(states[-1, 1]) < 1e-9
        assert low - 1e-9 <= states[:, 0].min()
        assert states[:, 0].max() <= high + 1e-9
        assert slow - 1e-9 <= states[:, 1].min()
        assert states[:, 1].max() <= fast + 1e-9
        step = end / 200 or 1.0
        speeds = np.diff(states[:, 1]) / step
        assert np.abs(speeds).max() <= most * (1 + 1e-6), "accelerations between the samples"
        assert stop_state(0.0, velocity, acceleration, phases, np.inf)[0] == pytest.approx(states[-1, 0])


def test_the_range_is_reached():
    """The range is no wider than the motion: its ends are turning points or the end."""
    for velocity, acceleration, most, jerk in starts(30):
        phases = stop_phases(velocity, acceleration, most, jerk)
        times = np.linspace(0, sum(phases[:3]), 501)
        positions = [stop_state(0.0, velocity, acceleration, phases, time)[0] for time in times]
        low, high, _, _ = stop_range(velocity, acceleration, most, jerk)
        assert low == pytest.approx(min(positions), abs=1e-4)
        assert high == pytest.approx(max(positions), abs=1e-4)


def test_time_is_counted_from_the_start_of_the_stop():
    phases = stop_phases(1.0, 0.0, 2.0, 8.0)
    positions = [stop_state(0.0, 1.0, 0.0, phases, time)[0] for time in (0.0, 0.25, 0.5, 0.75, 9.0)]
    assert positions == pytest.approx([0, 0.25 - 8 * 0.25**3 / 6, 0.354166667, 0.375, 0.375])
    assert all(before <= after for before, after in itertools.pairwise(positions))


def test_a_stop_is_proven_just_when_its_whole_range_is_within_the_limits():
    """The velocity at which the acceleration is 0 is looked at first: it must turn away no stop that is legal."""
    draw, answers = random.Random(5), set()
    for velocity, acceleration, most, jerk in starts(2000):
        axis = PositionAxis(JointLimits("x", "rad", -1.0, 1.0, (-1.2, 0.9), most, jerk), 3.0)
        value = draw.uniform(-1.0, 1.0)
        low, high, slow, fast = stop_range(velocity, acceleration, axis.max_acceleration, axis.max_jerk)
        legal = value + low >= -1.0 and value + high <= 1.0 and slow >= -1.2 and fast <= 0.9
        assert (axis._proof(value, velocity, acceleration) is not None) == legal
        answers.add((legal, velocity > 0, acceleration > 0))
    assert len(answers) == 8


def test_no_stop_of_a_robot_takes_longer_than_ruckigs_by_more_than_a_tenth_and_a_step():
    ruckig = pytest.importorskip("ruckig", reason="Ruckig is an oracle of this test alone: pip install ruckig")
    limits, period = RobotLimits.named("ur5e"), 0.01
    wave = np.sin(np.linspace(0, 6, 400))[:, None] * np.linspace(0.1, 0.5, 6)
    for length in (60, 130, 200, 290):
        envelope = Envelope(limits, period)
        envelope.start([0.0] * 6)
        for command in wave[:length]:
            envelope.step(command, elapsed_s=period)
        sent = np.array([envelope.step(None, elapsed_s=period).command for _ in range(3)])
        steps = 0
        while not envelope.at_rest():
            envelope.step(None, elapsed_s=period)
            steps += 1
        wanted = ruckig.InputParameter(6)
        wanted.control_interface = ruckig.ControlInterface.Velocity
        wanted.current_velocity = ((sent[2] - sent[1]) / period).tolist()
        wanted.current_acceleration = (np.diff(sent, 2, axis=0)[0] / period**2).tolist()
        wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [9.0] * 6, [3.0] * 6, [60.0] * 6
        trajectory = ruckig.Trajectory(6)
        assert ruckig.Ruckig(6).calculate(wanted, trajectory) == ruckig.Result.Working
        assert steps * period <= 1.1 * trajectory.duration + period


def test_no_stop_is_longer_than_that_of_ruckig():
    """Ruckig computes the time-optimal stop of its interface for velocities."""
    ruckig = pytest.importorskip("ruckig", reason="Ruckig is an oracle of this test alone: pip install ruckig")
    for velocity, acceleration, most, jerk in starts(60):
        wanted = ruckig.InputParameter(1)
        wanted.control_interface = ruckig.ControlInterface.Velocity
        wanted.current_velocity, wanted.current_acceleration = [velocity], [acceleration]
        wanted.target_velocity, wanted.target_acceleration = [0.0], [0.0]
        wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [100.0], [most], [jerk]
        trajectory = ruckig.Trajectory(1)
        assert ruckig.Ruckig(1).calculate(wanted, trajectory) == ruckig.Result.Working
        assert sum(stop_phases(velocity, acceleration, most, jerk)[:3]) <= 1.001 * trajectory.duration + 1e-9


def test_many_stops_at_many_times_are_each_of_them_bit_for_bit():
    cases = starts(200)
    begin = np.random.default_rng(3).uniform(-2, 2, len(cases))
    phases = [stop_phases(*case) for case in cases]
    ends = np.array([sum(each[:3]) for each in phases])
    times = np.linspace(0.0, 1.2, 9)[:, None] * ends
    found = stop_positions(begin, *np.array(cases).T[:2], np.array(phases).T, times)
    for column, ((velocity, acceleration, _, _), each) in enumerate(zip(cases, phases, strict=True)):
        start = (float(begin[column]), velocity, acceleration)
        assert found[:, column].tolist() == [stop_state(*start, each, float(t))[0] for t in times[:, column]]
