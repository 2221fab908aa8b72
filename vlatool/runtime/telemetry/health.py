"""Health of the components of a robot: heartbeats with time-outs, and how much each is degraded."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from vlatool.errors import UsageError
from vlatool.runtime.arguments import check_positive
from vlatool.runtime.interface import POLICY
from vlatool.runtime.telemetry.record import TickRecord

CONTROLLER = "controller"


class HealthLevel(IntEnum):
    """How well a component works: as it should, with less than that, or not at all."""

    OK = 0
    DEGRADED = 1
    FAILED = 2


@dataclass(frozen=True)
class Timeout:
    """How long a component may be silent.

    Args:
        degraded_s: Time since its last heartbeat from which it is degraded, in seconds.
        failed_s: From which it has failed.

    Raises:
        UsageError: when they are not numbers above 0 in order.
    """

    degraded_s: float
    failed_s: float

    def __post_init__(self) -> None:
        for name in ("degraded_s", "failed_s"):
            check_positive(name, getattr(self, name), "a number of seconds")
        if self.failed_s < self.degraded_s:
            raise UsageError(
                f"failed_s is {self.failed_s:g} and degraded_s {self.degraded_s:g}; allowed: the same or longer.",
                "pass Timeout(degraded_s=0.2, failed_s=1.0)",
            )


class Health:
    """What is known of each component; one that was never heard of has failed after its time-out.

    Any thread may report a heartbeat. As a sink it reports those of the components ``controller`` (each control step)
    and ``policy`` (each with an action of it; degraded while a fallback has the robot), where they have a time-out.

    Args:
        timeouts: Component -> how long it may be silent.
        clock: Returns seconds.
    """

    def __init__(self, timeouts: Mapping[str, Timeout], *, clock: Callable[[], float] = time.monotonic) -> None:
        if not isinstance(timeouts, Mapping) or not all(isinstance(each, Timeout) for each in timeouts.values()):
            raise UsageError(f"timeouts is {timeouts!r:.80}; allowed: component -> Timeout.",
                             'pass {"camera": Timeout(0.2, 1.0)}')  # fmt: skip
        self._timeouts, self._clock = dict(timeouts), clock
        self._lock = threading.Lock()
        self._beats = {name: (clock(), HealthLevel.OK, "") for name in timeouts}

    def __call__(self, record: Any) -> None:
        """Take a record."""
        if not isinstance(record, TickRecord):
            return
        if CONTROLLER in self._timeouts:
            self.beat(CONTROLLER)
        if POLICY in self._timeouts and not record.missed:
            stands = HealthLevel.DEGRADED if record.level else HealthLevel.OK
            self.beat(POLICY, stands, f"the fallback stands on rung {record.level}" if record.level else "")

    def beat(self, name: str, level: HealthLevel = HealthLevel.OK, reason: str = "") -> None:
        """Report that a component lives, and how well it works.

        Raises:
            UsageError: when there is no such component.
        """
        if name not in self._timeouts:
            raise UsageError.unknown(f"There is no component '{name}'", name, sorted(self._timeouts))
        with self._lock:
            self._beats[name] = self._clock(), HealthLevel(level), reason

    def levels(self) -> dict[str, tuple[HealthLevel, str]]:
        """Return the level of each component, and why; the worse of what it says and of its silence."""
        now = self._clock()
        with self._lock:
            beats = dict(self._beats)
        return {name: self._level(name, now - beat, level, reason) for name, (beat, level, reason) in beats.items()}

    def _level(self, name: str, silent_s: float, level: HealthLevel, reason: str) -> tuple[HealthLevel, str]:
        timeout = self._timeouts[name]
        limits = ((timeout.failed_s, HealthLevel.FAILED), (timeout.degraded_s, HealthLevel.DEGRADED))
        silent = next((worse for limit, worse in limits if silent_s > limit), HealthLevel.OK)
        return (level, reason) if silent <= level else (silent, f"silent for {silent_s:.3g} s")

    @property
    def worst(self) -> HealthLevel:
        """The worst level of all components."""
        return max((level for level, _ in self.levels().values()), default=HealthLevel.OK)
