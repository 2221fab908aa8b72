"""An inference as a robot calls it, with idle time in between, beside a busy loop and single shots.

Between two control steps a processor lowers its clock, sleeps, and gives its caches to others: what a busy loop
measures is not what a robot gets.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.measurement.results import DutyMode
from vlatool.measures import latency
from vlatool.report import Measurement
from vlatool.runtime.policy import Policy
from vlatool.stats.intervals import quantile_interval

BUSY, DUTY, SINGLE = "busy loop", "at the robot's rate", "single shots"
BUSY_CALLS, DUTY_CALLS = 10, 10
"""Calls of one round; one single shot closes it."""
IDLE_S = 0.3
"""Idle time before a single shot, or one period where that is longer."""
FEWEST_ROUNDS = 6
OF_MODE = {BUSY: latency.LATENCY_BUSY_P50, DUTY: latency.LATENCY_DUTY_P50, SINGLE: latency.LATENCY_SINGLE_P50}
RATIO_OF_MODE = {DUTY: latency.DUTY_RATIO, SINGLE: latency.SINGLE_RATIO}


@dataclass(frozen=True)
class _Waiting:
    """How time is told and passed."""

    clock: Callable[[], float]
    sleep: Callable[[float], None]


def time_duty_cycle(
    policy: Policy,
    observations: Sequence[Mapping[str, Any]],
    rate: float,
    seconds: float,
    *,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> tuple[DutyMode, ...]:
    """Time calls of three kinds in turns.

    Args:
        observations: observations, used in turns.
        rate: Control steps in a second.
        seconds: Time after which no further round begins, once there are ``FEWEST_ROUNDS``.
        clock, sleep: Functions in seconds, replaced in tests.

    Returns:
        The milliseconds of the calls of each kind, by round; the first calls of a busy loop belong to the way there.
    """
    waiting, taken = _Waiting(clock, sleep), {mode: [] for mode in (BUSY, DUTY, SINGLE)}  # type: ignore[var-annotated]
    calls = 0

    def call() -> float:
        nonlocal calls
        observation = observations[calls % len(observations)]
        if not calls % len(observations):
            policy.reset()
        calls += 1
        begin = clock()
        policy.infer(observation)
        return (clock() - begin) * 1e3

    end = clock() + seconds
    while len(taken[SINGLE]) < FEWEST_ROUNDS or clock() < end:
        taken[BUSY].append([call() for _ in range(BUSY_CALLS + 1)][1:])
        taken[DUTY].append(_at_rate(call, rate, waiting))
        sleep(max(IDLE_S, 1 / rate))
        taken[SINGLE].append([call()])
    return tuple(DutyMode(mode, tuple(map(tuple, rounds))) for mode, rounds in taken.items())


def _at_rate(call: Callable[[], float], rate: float, waiting: _Waiting) -> list[float]:
    """Return the milliseconds of calls that begin a period apart, or one after the other where one takes longer."""
    times, due = [], waiting.clock() + 1 / rate
    for _ in range(DUTY_CALLS):
        waiting.sleep(max(0.0, due - waiting.clock()))
        times.append(call())
        due = max(due + 1 / rate, waiting.clock())
    return times


def duty_measurements(modes: Sequence[DutyMode], rate: float) -> list[Measurement]:
    """Return the median of each kind of calls, and its ratio to that of a busy loop, with the interval over rounds."""
    found, busy = [], next((mode for mode in modes if mode.name == BUSY), None)
    for mode in modes:
        about = f"{mode.name}, {rate:g} Hz" if mode.name == DUTY else mode.name
        found.append(OF_MODE[mode.name].measurement(mode.p50_ms, samples=mode.calls, note=about))
        if busy is not None and mode.name in RATIO_OF_MODE:
            found.append(_ratio(mode, busy, f"{about}, by a busy loop; rounds in turn"))
    return found


def _ratio(mode: DutyMode, busy: DutyMode, note: str) -> Measurement:
    """Return the ratio of medians, with the interval of the median of the ratios within rounds."""
    rounds = zip(mode.rounds_ms, busy.rounds_ms, strict=True)
    _, low, high = quantile_interval([float(np.median(own) / np.median(base)) for own, base in rounds], 0.5)
    ratio = mode.p50_ms / busy.p50_ms
    low, high = (min(low, ratio) if low else low), (max(high, ratio) if high else high)
    return RATIO_OF_MODE[mode.name].measurement(ratio, samples=mode.calls, low=low, high=high, note=note)


def duty_table(modes: Sequence[DutyMode]) -> list[dict[str, Any]]:
    """Return the kinds of calls as rows of a table."""
    busy = next((mode.p50_ms for mode in modes if mode.name == BUSY), 0.0)
    return [{"calls": mode.name, "number": mode.calls, "p50 ms": round(mode.p50_ms, 5), "max ms": round(mode.max_ms, 5),
             "by the busy loop": round(mode.p50_ms / busy, 2) if busy else None} for mode in modes]  # fmt: skip
