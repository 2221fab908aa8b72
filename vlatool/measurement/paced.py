"""A control loop at a fixed rate: what each of its ticks gets, measured from the moment at which the tick was due.

The loop wants one action at every tick, from an observation of that tick, before the next one. It sleeps until a tick
is due, infers, and goes on to the newest tick that is due then: those in between were passed over while the policy
computed. Such a tick has waited for the next action all the same, so it counts with the time until that action
(otherwise one stall of 50 ms at 100 Hz would count once instead of five times: coordinated omission).
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from vlatool.measurement.answers import Answers
from vlatool.measurement.interleaved import percentile_measurements
from vlatool.measurement.results import Pace
from vlatool.measures import Family
from vlatool.measures.latency import AGE, AGE_MAX, DEADLINE_MISSES, WAKEUP
from vlatool.report import Measurement
from vlatool.runtime.policy import Policy
from vlatool.stats.intervals import wilson

TELL_S = 1.0
"""Seconds between two reports of progress."""
SLACK_S = 4e-3
"""Time until the next tick in which ``between`` may be called."""
OVERLOAD = 0.01
"""Share of ticks that are passed over from which a loop is too fast for the policy: ticks that share an inference are
no independent samples, and no bound is given for them."""


def _doubles() -> array[float]:
    return array("d")


@dataclass
class Ticks:
    """What a loop saw, one entry for each tick.

    Args:
        period_ms: between two ticks.
        response_ms: from the moment at which a tick was due to the action that served it.
        due_s: time at which it was due (``time.monotonic``).
        wakeup_ms: delay with which the loop woke up for a tick that it slept until.
        served: ticks that each inference served.
        age_ms: age of the observation behind the newest action when the tick was due; from the second action on.
        passed_over: ticks that began and ended while the policy computed.
    """

    period_ms: float
    response_ms: array[float] = field(default_factory=_doubles)
    due_s: array[float] = field(default_factory=_doubles)
    wakeup_ms: array[float] = field(default_factory=_doubles)
    age_ms: array[float] = field(default_factory=_doubles)
    served: array[int] = field(default_factory=lambda: array("q"))
    passed_over: int = 0

    @property
    def misses(self) -> int:
        """Ticks whose action came after the next tick was due."""
        return sum(value > self.period_ms for value in self.response_ms)

    def pace(self) -> Pace:
        """Return what counts for the whole loop."""
        return Pace(
            period_ms=self.period_ms,
            wakeup_ms=tuple(self.wakeup_ms),
            age_ms=tuple(self.age_ms),
            misses=self.misses,
            passed_over=self.passed_over,
            inferences=len(self.served),
            effective_sample_size=sum(self.served) ** 2 / max(1, sum(count * count for count in self.served)),
        )


def run_paced(
    policy: Policy,
    observations: Sequence[Mapping[str, Any]],
    rate: float,
    ticks: int,
    answers: Answers | None = None,
    tell: Callable[[str, float | None], None] = lambda what, share: None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    between: Callable[[float], None] = lambda share: None,
) -> Ticks:
    """Serve ticks of a control loop.

    Args:
        observations: observations, used in turns.
        rate: ticks in a second.
        answers: expected answers of the policy.
        tell: callback: what is being done, and the share that is done.
        clock, sleep: functions in seconds, replaced in tests.
        between: function called with the share of ticks that are done, where there is time until the next.
    """
    period = 1.0 / rate
    ticked = Ticks(period * 1e3)
    begun = clock() + period
    tick, served, last_told = 0, 0, -TELL_S
    actions: list[tuple[float, float]] = []  # the last two: when the observation was taken, when the action was there
    while tick < ticks:
        index = served % len(observations)
        if not index:
            policy.reset()
        if (now := clock()) - last_told >= TELL_S:
            tell(f"serving ticks at {rate:g} Hz", tick / ticks)
            last_told = now
        due = begun + tick * period
        if (left := due - clock()) > 0:
            sleep(left)
            ticked.wakeup_ms.append((clock() - due) * 1e3)
        now = clock()
        newest = min(ticks - 1, max(tick, int((now - begun) / period)))
        action = policy.infer(observations[index])
        done = clock()
        ticked.passed_over += newest - tick
        ticked.served.append(newest + 1 - tick)
        for number in range(tick, newest + 1):
            when = begun + number * period
            ticked.due_s.append(when)
            ticked.response_ms.append((done - when) * 1e3)
            if there := [taken for taken, ready in actions if ready <= when]:
                ticked.age_ms.append((when - there[-1]) * 1e3)
        actions = [*actions[-1:], (now, done)]
        served, tick = served + 1, newest + 1
        if answers is not None:
            answers.look(index, action.outputs)
        if begun + tick * period - clock() > SLACK_S:
            between(tick / ticks)
    return ticked


def paced_measurements(pace: Pace, ticks: int, rate: float) -> list[Measurement]:
    """Return misses, ages and lateness of a loop."""
    size = 0 if is_overloaded(pace, ticks) else int(pace.effective_sample_size)
    low, high = wilson(min(size, round(pace.misses * size / ticks)), size) if size else (None, None)
    note = f"ticks at {rate:g} Hz whose action came after the next tick, {pace.period_ms:g} ms later; "
    note += f"{pace.inferences:,} inferences, {pace.passed_over:,} ticks passed over while the policy computed"
    measured = [DEADLINE_MISSES.measurement(pace.misses / ticks, samples=ticks, low=low, high=high, note=note)]
    if ages := pace.age_ms:
        about = "age of the observation behind the newest action when a tick is due"
        measured += _percentiles(AGE, ages, size, ticks / rate, about)
        measured.append(AGE_MAX.measurement(max(ages), samples=len(ages), note=about))
    if pace.wakeup_ms:
        about = "how late the loop wakes up for a tick that it slept until"
        measured += _percentiles(WAKEUP, pace.wakeup_ms, size, ticks / rate, about)
    return measured


def _percentiles(what: Family, samples: Sequence[float], size: float, seconds: float, about: str) -> list[Measurement]:
    percentiles = percentile_measurements(what, samples, (50.0, 99.0), True, size, seconds)
    return [replace(percentile, note=percentile.note or about) for percentile in percentiles]


def is_overloaded(pace: Pace, ticks: int) -> bool:
    """Say whether so many ticks share an inference that nothing can be bounded."""
    return pace.passed_over > OVERLOAD * ticks
