"""Sensors whose samples come late, repeated, frozen, in another order, and whose clocks are set; the truth is known."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from vlatool.runtime.sensors import SensorLimits, Sensors

STALE_S = {"camera": 0.25, "joints": 0.1}
PERIOD_S = {"camera": 1 / 30, "joints": 1 / 100}
TICK_S = 0.05
TRANSPORT_S = 0.004
"""Least time from a measurement to its arrival, which no stamp shows."""
SLACK = 0.25
"""Share of the limit by which an age may be wrong (``sensors.SPREAD``)."""


@dataclass
class Faults:
    """The samples of one sensor of an episode: (arrival, value, stamp), where the value is the true time.

    Args:
        kind: Of ``KINDS``, or ``all`` of them in turns.
    """

    KINDS: ClassVar[tuple[str, ...]] = ("jitter", "stall", "reorder", "duplicate", "freeze", "clock", "stamp")

    random: np.random.Generator
    kind: str
    period: float
    samples: list[tuple[float, float, float]] = field(default_factory=list)

    def fill(self, end: float) -> list[tuple[float, float, float]]:
        """Return the samples up to a time, in the order of their arrival."""
        offset, drift = self.random.uniform(-1e6, 1e6), self.random.uniform(-5e-5, 5e-5)
        ends, frozen, fault = 0.0, 0.0, ""
        now = 0.0
        while now < end:
            if now >= ends and now > 3:
                kinds = self.KINDS if self.kind == "all" else (self.kind,)
                fault = str(self.random.choice(kinds)) if self.random.random() < 0.5 else ""
                ends, frozen = now + self.random.uniform(0.1, 2.5), now
                if fault == "clock":
                    offset += self.random.choice([-3600.0, 3600.0]) * self.random.uniform(0.5, 1)
            self._send(now, now * (1 + drift) + offset, fault, ends, frozen)
            now += self.period
        return sorted(self.samples)

    def _send(self, now: float, stamp: float, fault: str, ends: float, frozen: float) -> None:
        late = TRANSPORT_S + self.random.exponential(0.002)
        value = frozen if fault == "freeze" else now
        if fault == "jitter":
            late += self.random.exponential(0.05)
        if fault == "stall":
            late += max(0.0, ends - now)
        if fault == "reorder" and self.random.random() < 0.3:
            late += self.random.uniform(0, 1.0)
        if fault == "stamp":
            stamp = float(self.random.choice([np.nan, np.inf, stamp + 5e3, stamp - 5e3, stamp]))
        self.samples.append((now + late, value, stamp))
        if fault == "duplicate":
            self.samples.append((now + late + self.random.uniform(0, 1.0), value, stamp))


def stale_readings(random: np.random.Generator, kind: str, ticks: int, *, believe: bool = False) -> tuple[int, int]:
    """Return how many readings were given as usable in so many ticks, and how many of them were stale.

    Args:
        believe: Count ages from arrivals alone, and repeated values as new ones.
    """
    now = [0.0]
    methods = {"camera": "nearest", "joints": "linear"}
    limits = {name: SensorLimits(stale, noisy=not believe, method=methods[name]) for name, stale in STALE_S.items()}
    sensors = Sensors(limits, 0.1, lambda: now[0])
    end = ticks * TICK_S
    queued: dict[str, Any] = {name: iter(Faults(random, kind, PERIOD_S[name]).fill(end)) for name in STALE_S}
    upcoming = {name: next(each) for name, each in queued.items()}
    usable = stale = 0
    for tick in range(ticks):
        now[0] = tick * TICK_S
        for name, each in queued.items():
            while upcoming[name] is not None and upcoming[name][0] <= now[0]:
                arrival, value, stamp = upcoming[name]
                sensors.add(name, np.array([value]), None if believe else stamp, arrival)
                upcoming[name] = next(each, None)
        reading = sensors.read()
        if not reading.problems:
            usable += 1
            ages = {name: now[0] - float(value[0]) for name, value in reading.observation.items()}
            stale += any(age > STALE_S[name] * (1 + SLACK) + TRANSPORT_S for name, age in ages.items())
    return usable, stale
