"""Buffers of sensors: values at a common time, and every way in which a sample is old without saying so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from _sensor_faults import Faults, stale_readings

from vlatool.errors import DataError, UsageError
from vlatool.runtime.sensors import SensorBuffer, SensorLimits, Sensors, fuse

LIMITS = SensorLimits(0.2, settle_s=0)


class Clock:
    """A clock that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def filled(method: str, samples: Mapping[float, Any]) -> SensorBuffer:
    buffer = SensorBuffer(SensorLimits(1.0, method=method))
    for moment, value in samples.items():
        buffer.add(value, arrival=moment)
    return buffer


def at(buffer: SensorBuffer, moment: float) -> Any:
    sample = buffer.at(moment)
    assert sample is not None
    return sample


def test_the_nearest_sample_is_given_and_the_ends_stand_for_what_is_beyond():
    buffer = filled("nearest", {1.0: 10.0, 2.0: 20.0, 4.0: 40.0})
    assert [at(buffer, t).value for t in (0, 1, 1.4, 1.5, 2.9, 3.1, 9)] == [10, 10, 10, 20, 20, 40, 40]
    assert at(buffer, 9).time == 4
    assert SensorBuffer(LIMITS).at(0) is None


def test_between_two_samples_numbers_are_in_proportion_and_rotations_turn():
    sample = at(filled("linear", {1.0: np.array([0.0, 1.0]), 2.0: np.array([1.0, 5.0])}), 1.25)
    np.testing.assert_allclose(sample.value, [0.25, 2])
    assert (sample.time, sample.oldest) == (1.25, 1)
    turns = {0.0: np.array([0, 0, 0, 1.0]), 1.0: -np.array([0, 0, np.sin(0.5), np.cos(0.5)])}
    turned = at(filled("quaternion_xyzw", turns), 0.3).value
    np.testing.assert_allclose(turned, [0, 0, np.sin(0.15), np.cos(0.15)], atol=1e-12)


def test_between_unsigned_integers_differences_do_not_wrap_around():
    buffer = filled("linear", {0.0: np.array([10, 5], np.uint8), 1.0: np.array([5, 10], np.uint8)})
    assert at(buffer, 0.5).value.tolist() == [7.5, 7.5]


@pytest.mark.parametrize(
    ("method", "values"),
    [("linear", [np.zeros(2), np.zeros(3)]), ("linear", [np.zeros(1), np.zeros(2)]), ("linear", ["a", "b"]),
     ("linear", [None, None]), ("linear", [np.array([True]), np.array([False])]),
     ("quaternion_xyzw", [np.ones(2), np.ones(2)]), ("matrix", [np.eye(3), np.eye(3)])],
)  # fmt: skip
def test_samples_between_which_nothing_lies_are_an_error_of_the_sensor(method: str, values: list[Any]):
    buffer = filled(method, dict(enumerate(values)))
    with pytest.raises(DataError):
        buffer.at(0.5)


def test_samples_that_are_dropped_while_a_clock_settles_are_counted_in_what_is_said():
    sensors = Sensors({"a": SensorLimits(0.2)}, clock=Clock())
    sensors.add("a", 1.0, stamp=5.0)
    assert sensors.read().problems == ("'a' has no sample that counts yet; dropped: 1",)


@pytest.mark.parametrize("wrong", [{"a": 0.1}, ["a"], "a"])
def test_limits_that_are_none_are_refused(wrong: Any):
    with pytest.raises(UsageError, match="allowed: the SensorLimits of each input"):
        Sensors(wrong)


@pytest.mark.parametrize("stamp", ["1.0", "now", b"1"])
def test_a_stamp_that_is_no_number_is_refused(stamp: Any):
    with pytest.raises(UsageError, match=r"stamp is .*; allowed: a number of seconds"):
        SensorBuffer(LIMITS).add(1.0, stamp=stamp)


def test_samples_in_another_order_are_put_in_order_and_repeated_ones_dropped():
    buffer = SensorBuffer(LIMITS)
    for stamp, arrival in ((0.0, 10.0), (0.2, 10.2), (0.1, 10.21), (0.2, 10.22)):
        buffer.add(stamp, stamp, arrival)
    assert [float(at(buffer, t).value) for t in (10.0, 10.1, 10.2)] == [0.0, 0.1, 0.2]
    assert buffer.newest == pytest.approx(10.2, abs=1e-3)


def test_the_sensor_of_a_sample_cannot_change_it_afterwards_and_old_ones_are_forgotten():
    frame = np.zeros(2)
    buffer = SensorBuffer(SensorLimits(1.0, capacity=2))
    for moment in (1.0, 2.0, 3.0):
        frame[:] = moment
        assert buffer.add(frame, arrival=moment)
    assert at(buffer, 0).value.tolist() == [2, 2]
    assert not buffer.add(frame, arrival=0.5)
    assert buffer.dropped == 1


def test_a_late_sample_has_the_age_of_its_measurement():
    clock = Clock()
    sensors = Sensors({"x": LIMITS}, clock=clock)
    for tick in range(5):
        clock.now = 100 + tick / 10
        sensors.add("x", tick, stamp=tick / 10)
    assert sensors.observation()["x"] == 4
    clock.now = 101.0
    sensors.add("x", 5, stamp=0.5)
    reading = sensors.read()
    assert reading.ages_s["x"] == pytest.approx(0.5, abs=1e-3)
    assert reading.problems == ("'x' is 0.5 s old; allowed: 0.2 s",)
    with pytest.raises(DataError, match=r"The sensors give no observation: 'x' is 0.5 s old"):
        sensors.observation()


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_clock_that_was_set_counts_again_when_it_has_settled(step: float):
    clock = Clock()
    sensors = Sensors({"x": SensorLimits(0.22, settle_s=0.5)}, clock=clock)
    usable = []
    for tick in range(60):
        clock.now = tick / 20
        sensors.add("x", tick, stamp=clock.now + (step if tick >= 30 else 0))
        usable.append(not sensors.read().problems)
    unusable = [tick for tick, there in enumerate(usable) if not there]
    assert unusable == [*range(10), *range(34, 40)], "at first, and when the last sample before the step is too old"
    assert not sensors.add("x", 1, stamp=float("nan"))


def test_a_backlog_is_not_taken_for_a_clock_that_was_set():
    """A link stalls for 2 s while the clock steps; what was sent meanwhile comes at once, and is old."""
    clock = Clock()
    sensors = Sensors({"x": SensorLimits(0.2, settle_s=0.5)}, clock=clock)
    for tick in range(40):
        clock.now = tick / 20
        sensors.add("x", clock.now, stamp=clock.now)
    clock.now = 4.0
    for tick in range(40, 80):
        clock.now += 1e-4
        sensors.add("x", tick / 20, stamp=tick / 20 - 3600)
        assert sensors.read().problems


def test_a_repeated_picture_is_as_old_as_the_first_one():
    clock = Clock()
    sensors = Sensors({"x": SensorLimits(0.2, noisy=True, settle_s=0)}, clock=clock)
    for tick, value in enumerate([1, 2, 2, 2, 2, 3]):
        clock.now = tick / 10
        sensors.add("x", np.full(3, value), stamp=clock.now)
        assert bool(sensors.read().problems) == (tick == 4)


def test_a_picture_that_froze_while_the_clock_settled_is_old():
    clock = Clock()
    sensors = Sensors({"x": SensorLimits(0.2, noisy=True, settle_s=0.5)}, clock=clock)
    for tick in range(20):
        clock.now = tick / 10
        sensors.add("x", "frozen", stamp=clock.now)
        assert sensors.read().problems


def test_all_values_are_of_the_newest_time_that_all_have():
    clock = Clock()
    sensors = Sensors({"fast": SensorLimits(0.5, method="linear"), "slow": SensorLimits(0.5)}, 0.05, clock)
    sensors.add("slow", 1.0, arrival=1.0)
    for tick in range(8):
        sensors.add("fast", float(tick), arrival=0.95 + tick / 10)
    clock.now = 1.3
    reading = sensors.read()
    assert (reading.time, reading.skew_s, reading.problems) == (1.0, 0.0, ())
    assert reading.observation["fast"] == pytest.approx(0.5)
    assert reading.ages_s == pytest.approx({"fast": 0.35, "slow": 0.3})


@pytest.mark.parametrize("method", ["linear", "nearest"])
def test_a_sample_that_is_still_to_come_changes_no_reading(method: str):
    clock = Clock()
    sensors = Sensors({"a": SensorLimits(0.1, method=method)}, clock=clock)
    clock.now = 1.0
    sensors.add("a", 1.0, arrival=0.98)
    sensors.add("a", 1000.0, arrival=1.01)
    reading = sensors.read()
    assert (reading.observation["a"], reading.problems) == (1.0, ())
    clock.now = 0.9
    assert sensors.read().problems, "nothing has come yet"


def test_what_is_missing_or_too_far_apart_is_said():
    clock = Clock()
    sensors = Sensors({"a": SensorLimits(5.0), "b": SensorLimits(5.0), "c": SensorLimits(5.0)}, 0.1, clock)
    sensors.add("a", 1, arrival=1.0)
    sensors.add("b", 1, arrival=1.5)
    clock.now = 2.0
    assert sensors.read().problems == ("'c' has no sample", "the values are 0.5 s apart; allowed: 0.1 s")
    sensors.clear()
    assert sensors.read().problems[:2] == ("'a' has no sample", "'b' has no sample")
    with pytest.raises(UsageError, match="There is no sensor 'd'"):
        sensors.add("d", 1)


@pytest.mark.parametrize(
    "arguments",
    [{"stale_s": 0}, {"stale_s": 1, "method": "cubic"}, {"stale_s": 1, "capacity": 1}, {"stale_s": 1, "latency_s": -1},
     {"stale_s": 1, "settle_s": -1}, {"stale_s": True}, {"stale_s": np.inf}, {"stale_s": np.nan},
     {"stale_s": 1, "latency_s": np.inf}],
)  # fmt: skip
def test_limits_out_of_range_are_refused(arguments: dict[str, Any]):
    with pytest.raises(UsageError):
        SensorLimits(**arguments)


@pytest.mark.parametrize("skew_s", [0, -1, np.inf, np.nan, "1"])
def test_a_skew_that_is_no_limit_is_refused(skew_s: Any):
    with pytest.raises(UsageError, match="skew_s is"):
        Sensors({"a": LIMITS}, skew_s=skew_s)


@pytest.mark.parametrize("kind", [*Faults.KINDS, "all"])
def test_no_reading_is_stale_under_faults(kind: str):
    for seed in range(3):
        readings, stale = stale_readings(np.random.default_rng(seed), kind, ticks=400)
        assert stale == 0
        assert readings > 50


def test_without_the_checks_readings_are_stale():
    """The faults are some: a buffer that believes each arrival gives old values as new."""
    _, stale = stale_readings(np.random.default_rng(0), "all", ticks=400, believe=True)
    assert stale > 20


def test_values_are_weighed_by_age_and_trust():
    assert fuse([(np.array([0.0]), 0.0, 1.0), (np.array([3.0]), 1.0, 1.0)], 1.0) == pytest.approx([1.0])
    assert fuse([(np.array([0.0]), 0.0, 3.0), (np.array([4.0]), 0.0, 1.0)], 1.0) == pytest.approx([1.0])
    one, other = np.array([0, 0, 0, 1.0]), np.array([0, 0, np.sin(0.2), np.cos(0.2)])
    mean = fuse([(one, 0.0, 1.0), (-other, 0.0, 1.0)], 1.0, "quaternion_xyzw")
    np.testing.assert_allclose(mean, [0, 0, np.sin(0.1), np.cos(0.1)], atol=1e-12)


@pytest.mark.parametrize(
    "samples", [[], [(1.0, 0.0, 0.0)], [(np.nan, 0.0, 1.0)], [(1.0, 0.0, -1.0), (1.0, 0.0, 2.0)], [(1.0, np.nan, 1.0)]]
)
def test_nothing_to_fuse_is_an_error(samples: Any):
    with pytest.raises(DataError, match="No sensor has a finite value"):
        fuse(samples, 1.0)
