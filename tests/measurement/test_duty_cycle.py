"""Calls as a robot makes them, beside a busy loop and single shots, in a time that tests make."""

from __future__ import annotations

from typing import Any

import pytest

from vlatool.measurement.duty_cycle import (
    BUSY,
    BUSY_CALLS,
    DUTY,
    DUTY_CALLS,
    FEWEST_ROUNDS,
    IDLE_S,
    SINGLE,
    duty_measurements,
    duty_table,
    time_duty_cycle,
)
from vlatool.measurement.results import DutyMode


class Cooling:
    """A policy that takes 1 ms, and 0.2 ms more for each 10 ms for which the processor was idle before, up to 1 ms."""

    def __init__(self) -> None:
        self.now, self.idle, self.calls, self.resets = 10.0, 0.0, 0, 0
        self.begins: list[float] = []

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.idle += seconds

    def infer(self, observation: Any) -> None:
        self.begins.append(self.now)
        self.now += 1e-3 + min(1.0, 20 * self.idle) / 1e3
        self.idle, self.calls = 0.0, self.calls + 1

    def reset(self) -> None:
        self.resets += 1

    def run(self, rate: float = 50.0, seconds: float = 0.0) -> dict[str, DutyMode]:
        found = time_duty_cycle(self, [{}, {}], rate, seconds, clock=self.clock, sleep=self.sleep)  # type: ignore[arg-type]
        return {mode.name: mode for mode in found}


def test_each_kind_of_calls_gets_its_own_idle_time():
    policy = Cooling()
    found = policy.run()
    assert found[BUSY].p50_ms == pytest.approx(1.0)
    assert found[DUTY].p50_ms == pytest.approx(1.38, abs=0.01)
    assert found[SINGLE].p50_ms == pytest.approx(2.0)
    assert [mode.calls for mode in found.values()] == [FEWEST_ROUNDS * each for each in (BUSY_CALLS, DUTY_CALLS, 1)]
    assert policy.resets == (policy.calls + 1) // 2
    busy = BUSY_CALLS + 1
    rates = [1 / (later - first) for first, later in zip(policy.begins[busy:], policy.begins[busy + 1 :], strict=False)]
    assert rates[: DUTY_CALLS - 1] == pytest.approx([50.0] * (DUTY_CALLS - 1))
    assert policy.begins[busy + DUTY_CALLS] - policy.begins[busy + DUTY_CALLS - 1] >= IDLE_S


def test_more_rounds_fill_the_time():
    assert Cooling().run(seconds=30.0)[SINGLE].calls > 40


def test_a_policy_slower_than_the_rate_is_called_one_after_the_other():
    found = Cooling().run(rate=5000.0)
    assert found[DUTY].p50_ms == pytest.approx(1.0, abs=0.01)
    assert found[DUTY].calls == FEWEST_ROUNDS * DUTY_CALLS


def test_the_ratios_stand_beside_the_medians():
    modes = tuple(Cooling().run().values())
    found = {each.name: each for each in duty_measurements(modes, 50.0)}
    assert found["latency_busy_p50"].value == pytest.approx(1.0)
    assert found["duty_ratio"].value == pytest.approx(1.38, abs=0.01)
    assert found["single_ratio"].value == pytest.approx(2.0)
    for name in ("duty_ratio", "single_ratio"):
        low, high = found[name].low, found[name].high
        assert low is None or (high is not None and low <= found[name].value <= high)
    assert "50 Hz" in str(found["duty_ratio"].note)
    table = duty_table(modes)
    assert [row["by the busy loop"] for row in table] == pytest.approx([1.0, 1.38, 2.0], abs=0.02)
    assert duty_measurements((), 50.0) == duty_table(()) == []
