from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from telemetry_boards import (
    NEVER_S,
    Clock,
    reasons,
)

from vlatool import registry
from vlatool.telemetry import Absent, Reader, Reading, Recorder, collect, open_all, recorder, summarise
from vlatool.telemetry._reading import counter, find, gauge, run_command
from vlatool.telemetry._summary import difference


def power(name: str, *points: tuple[float, float]) -> list[tuple[float, Reading]]:
    return [(time_s, Reading(name, watts, "W", "gauge")) for time_s, watts in points]


def energy(name: str, wraps: float | None, *points: tuple[float, float]) -> list[tuple[float, Reading]]:
    return [(time_s, Reading(name, joules, "J", "counter", wraps)) for time_s, joules in points]


class Scripted(Reader):
    """Gives the readings of a list, one list after the other; then the last again."""

    name = "scripted"

    def __init__(self, *reads: list[Reading] | Exception) -> None:
        self.reads = [*reads]
        self.count = 0

    @classmethod
    def open(cls, root: Path = Path("/"), run: Any = None) -> Scripted:
        return cls()

    def read(self) -> list[Reading]:
        found = self.reads[min(self.count, len(self.reads) - 1)]
        self.count += 1
        if isinstance(found, Exception):
            raise found
        return found


class Slow(Scripted):
    name = "slow"
    period_s = 1.0


def watts(value: float) -> list[Reading]:
    return gauge("ina.VDD_IN", value, "W")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_reading_is_finite(value: float) -> None:
    with pytest.raises(ValueError, match="must be finite"):
        Reading("x", value, "W", "gauge")
    assert gauge("x", value, "W") == []
    assert counter("x", value, "J") == []
    assert gauge("x", None, "W") == []


@pytest.mark.parametrize(
    ("values", "wraps", "moved"),
    [
        ([5.0, 7.0, 7.0, 12.0], None, 7.0),
        ([90.0, 98.0, 3.0], 100.0, 13.0),
        ([90.0, 10.0, 90.0, 10.0], 100.0, 120.0),
        ([100.0, 0.0], 100.0, 0.0),
        ([90.0, 3.0], None, None),
        ([500.0, 3.0], 100.0, None),
        ([4.0], None, 0.0),
    ],
)
def test_differences_of_counters(values: list[float], wraps: float | None, moved: float | None) -> None:
    assert difference(values, wraps) == moved


def test_nothing_sampled_is_nothing_measured() -> None:
    found = summarise({}, [Absent("rapl", "no")])
    assert (found.seconds, found.gauges, found.counters, found.energy) == (0.0, {}, {}, ())
    assert found.throttled is None
    assert {*reasons(found)} == {"rapl", "energy"}


def test_a_gauge_has_least_mean_most_and_its_series() -> None:
    samples = [
        (float(time_s), Reading("thermal.cpu", value, "degC", "gauge")) for time_s, value in enumerate((40, 50, 45))
    ]
    found = summarise(collect(samples)).gauges["thermal.cpu"]
    assert (found.min, found.mean, found.max, found.unit) == (40, 45, 50, "degC")
    assert (found.times, found.values) == ((0, 1, 2), (40, 50, 45))


def test_power_is_integrated_with_the_trapezoid_rule_over_uneven_times() -> None:
    found = summarise(collect(power("ina.VDD_IN", (0, 5), (1, 7), (4, 1))))
    (one,) = found.energy
    assert (one.joules, one.seconds, one.source, one.samples) == (18.0, 4.0, "power samples", 3)
    assert one.mean_w == 4.5


def test_the_rails_below_the_input_rail_are_not_added() -> None:
    samples = power("ina.VDD_IN", (0, 5), (2, 5)) + power("ina.VDD_SOC", (0, 2), (2, 2))
    (one,) = summarise(collect(samples)).energy
    assert (one.joules, one.names) == (10.0, ("ina.VDD_IN",))


def test_a_sample_without_one_rail_of_a_sum_is_left_out() -> None:
    samples = power("ina.VDD_GPU_SOC", (0, 1), (1, 100), (2, 1)) + power("ina.VDD_CPU_CV", (0, 2), (2, 2))
    (one,) = summarise(collect(samples)).energy
    assert (one.joules, one.samples) == (6.0, 2)
    assert one.label == "module sum, without VIN_SYS_5V0, without VDDQ_VDD2_1V8AO"


def test_one_sample_is_no_energy() -> None:
    found = summarise(collect(power("ina.VDD_IN", (0, 5))))
    assert found.energy == ()
    assert "fewer than two samples" in reasons(found)["energy"]


def test_power_that_is_no_total_is_said_to_be_unmeasured() -> None:
    found = summarise(collect(power("ina.VDD_SRAM", (0, 5), (1, 5))))
    assert found.energy == ()
    assert "energy is unmeasured" in reasons(found)["energy"]


def test_energy_of_a_counter_that_wraps_around() -> None:
    found = summarise(collect(energy("rapl.package-0", 100.0, (0, 95), (5, 99), (10, 15))))
    (one,) = found.energy
    assert (one.joules, one.mean_w, one.source) == (20.0, 2.0, "counter")
    assert one.label == "package, without the board"
    assert found.counters["rapl.package-0"].difference == 20.0


def test_energy_of_two_packages_is_added_over_the_samples_that_both_have() -> None:
    samples = energy("rapl.package-0", None, (0, 0), (5, 10), (10, 20)) + energy("rapl.package-1", None, (0, 1), (5, 4))
    (one,) = summarise(collect(samples)).energy
    assert (one.joules, one.seconds) == (13.0, 5.0)


def test_a_counter_that_goes_back_is_unmeasured() -> None:
    found = summarise(collect(energy("rapl.package-0", None, (0, 50), (10, 3))))
    assert (found.counters, found.energy) == ({}, ())
    assert "went back" in reasons(found)["rapl.package-0"]
    assert "went back" in reasons(found)["energy"]


def test_a_counter_that_was_read_once_is_unmeasured() -> None:
    found = summarise(collect(energy("rapl.package-0", None, (0, 50))))
    assert found.counters == {}
    assert "read only once" in reasons(found)["rapl.package-0"]


def throttle(kind: str, *values: float) -> Iterable[tuple[float, Reading]]:
    make = gauge if kind == "gauge" else counter
    return [
        (float(time_s), one) for time_s, value in enumerate(values) for one in make("x", value, "throttle", note="hot")
    ]


@pytest.mark.parametrize(
    ("kind", "values", "throttled", "words"),
    [
        ("gauge", (0, 0, 0), False, ()),
        ("gauge", (0, 1, 0), True, ("hot (set in a sample)",)),
        ("counter", (7, 7, 7), False, ()),
        ("counter", (7, 7, 9), True, ("hot (2 more)",)),
        ("counter", (7,), None, ()),
    ],
)
def test_throttling(kind: str, values: tuple[float, ...], throttled: bool | None, words: tuple[str, ...]) -> None:
    found = summarise(collect(throttle(kind, *values)))
    assert (found.throttled, found.throttling) == (throttled, words)


def test_notes_that_change_are_all_kept() -> None:
    samples = [
        (0.0, Reading("m", 1, "count", "gauge", note="25W")),
        (1.0, Reading("m", 0, "count", "gauge", note="15W")),
    ]
    assert summarise(collect(samples)).gauges["m"].note == "25W, then 15W"


def test_a_recorder_samples_at_the_start_and_at_the_end() -> None:
    clock, reader = Clock(), Scripted(watts(4.0), watts(6.0))
    with Recorder([reader, Absent("rapl", "no")], NEVER_S, clock) as found:
        clock.now += 10.0
    assert reader.count == 2
    assert found.summary.energy[0].joules == 50.0
    assert found.summary.seconds == 10.0
    assert reasons(found.summary) == {"rapl": "no"}


def test_a_slow_reader_is_asked_once_in_its_period_and_at_the_ends() -> None:
    clock, slow, fast = Clock(), Slow(watts(1.0)), Scripted(watts(1.0))
    with Recorder([slow, fast], NEVER_S, clock) as found:
        for _ in range(25):
            clock.now += 0.1
            found.sample()
    assert fast.count == 27
    assert slow.count == 4


def test_the_thread_samples_by_itself_and_stops() -> None:
    woken = threading.Event()

    class Waking(Scripted):
        def read(self) -> list[Reading]:
            found = super().read()
            if self.count >= 4:
                woken.set()
            return found

    reader = Waking(watts(1.0))
    with Recorder([reader], period_s=0.001) as found:
        assert woken.wait(5.0)
    count = reader.count
    assert count >= 5
    assert not any(thread.name == "telemetry" for thread in threading.enumerate())
    assert found.summary.gauges["ina.VDD_IN"].mean == 1.0


def test_a_reader_that_fails_is_dropped_and_named() -> None:
    clock, good = Clock(), Scripted(watts(2.0))
    bad = Slow([], RuntimeError("bus error"))
    with Recorder([bad, good], NEVER_S, clock) as found:
        clock.now += 1.0
        found.sample()
        clock.now += 1.0
    assert bad.count == 2
    assert "bus error" in reasons(found.summary)["slow"]
    assert found.summary.energy[0].joules == 4.0


def test_an_error_of_the_run_is_not_hidden() -> None:
    reader = Scripted(watts(1.0))
    with pytest.raises(KeyError), Recorder([reader], NEVER_S):
        raise KeyError("the run failed")
    assert reader.count == 2


def test_a_reader_that_does_not_return_costs_the_last_samples_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "STOP_TIMEOUT_S", 0.01)
    held, entered = threading.Event(), threading.Event()

    class Stuck(Scripted):
        def read(self) -> list[Reading]:
            if self.count:
                entered.set()
                held.wait(5.0)
            return super().read()

    with Recorder([Stuck(watts(1.0))], period_s=0.001) as found:
        assert entered.wait(5.0)
    assert "did not return" in reasons(found.summary)["recorder"]
    held.set()


@pytest.mark.parametrize("period_s", [0.0, -1.0, math.nan, math.inf])
def test_a_period_is_above_zero(period_s: float) -> None:
    with pytest.raises(ValueError, match="above zero"):
        Recorder([], period_s)


def test_every_file_of_the_folder_is_a_reader_or_the_recorder() -> None:
    classes = {name: registry.load("telemetry", name) for name in registry.names("telemetry")}
    assert classes.pop("recorder") is Recorder
    assert all(issubclass(found, Reader) and found.name == name for name, found in classes.items())
    assert len(classes) == 11


def test_this_machine_can_be_recorded_whatever_it_has() -> None:
    with Recorder(open_all(), NEVER_S) as found:
        pass
    assert found.summary.seconds >= 0
    json.dumps(asdict(found.summary), allow_nan=False)


def test_entries_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for name in ("zone10", "zone9", "zone1"):
        (tmp_path / "a" / name).mkdir(parents=True)
    assert find(tmp_path, "a", "zone*") == ["a/zone1", "a/zone9", "a/zone10"]
    assert find(tmp_path, "none", "*") == []


def test_commands_that_fail_or_hang_give_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_command([sys.executable, "-c", "print('x')"]) == "x\n"
    assert run_command([sys.executable, "-c", "raise SystemExit(3)"]) is None
    assert run_command(["no-such-command-at-all"]) is None
    monkeypatch.setattr("vlatool.telemetry._reading.COMMAND_TIMEOUT_S", 0.02)
    assert run_command([sys.executable, "-c", f"import time; time.sleep({NEVER_S})"]) is None


def test_a_series_costs_sixteen_bytes_a_sample() -> None:
    series = collect(power("ina.VDD_IN", *((float(n), 5.0) for n in range(1000))))["ina.VDD_IN"]
    assert series.times.itemsize + series.values.itemsize == 16
    assert time.get_clock_info("monotonic").monotonic
