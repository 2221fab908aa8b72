"""Readings that slow or stop a robot: obstacle distance, battery, motor current, external torque, distance of two arms.

A monitor is one number with bands. Which number, and how it is measured, is the caller's: the same class watches the
speed of a base while its arm moves, and the temperature of a motor.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import isfinite
from typing import Any

from vlatool.errors import UsageError


class Level(IntEnum):
    """How safe a step was.

    ``SAFE``: the command passed as it was. ``WARNING``: it was slowed, or moved onto a limit. ``CRITICAL``: a step of
    the proven stop was sent instead. ``EMERGENCY``: the same at every step, until ``Envelope.clear``.
    """

    SAFE = 0
    WARNING = 1
    CRITICAL = 2
    EMERGENCY = 3


@dataclass(frozen=True)
class Monitor:
    """A reading with bands: beyond ``warning`` commands are slowed, beyond ``critical`` the robot stops.

    The larger value is the worse one if ``critical`` is above ``warning``, else the smaller one. A reading that is
    missing, or not a finite number, is critical.

    Args:
        name: key of the reading, and name of the check in results.
        warning: from here on, velocities are scaled: linearly, from 1 here to ``slowest`` at ``critical``.
        critical: from here on, the robot follows its proven stop, while the reading stays there.
        emergency: from here on, the robot stops and stays stopped until ``Envelope.clear``; None for never.
        slowest: scale of the velocities just before ``critical``.
        joints: joints that are slowed, and whose velocity is brought to 0 beyond ``critical``; all when empty.

    Raises:
        UsageError: when the bands are not finite numbers in order, or the scale is not in [0, 1].

    Example:
        >>> Monitor("obstacle_m", warning=1.0, critical=0.4).scale(0.7)
        0.55
    """

    name: str
    warning: float
    critical: float
    emergency: float | None = None
    slowest: float = 0.1
    joints: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        bands = [self.warning, self.critical, *([] if self.emergency is None else [self.emergency])]
        if not all(_is_finite(band) for band in (*bands, self.slowest)):
            raise self._refusal("allowed: finite numbers")
        signed = [self._sign * band for band in bands]
        if sorted({*signed}) != signed or not 0 <= self.slowest <= 1:
            raise self._refusal("allowed: warning, critical, emergency in order, and slowest from 0 to 1")

    @property
    def _sign(self) -> float:
        return 1.0 if self.critical > self.warning else -1.0

    def _refusal(self, allowed: str) -> UsageError:
        bands = f"{self.warning}, {self.critical}, {self.emergency} and slowest {self.slowest}"
        return UsageError(f"The monitor {self.name} has the bands {bands}; {allowed}.", "correct its bands")

    def level(self, reading: Any) -> Level:
        """Return how bad a reading is."""
        if not _is_finite(reading):
            return Level.CRITICAL
        worse = self._sign * reading
        if self.emergency is not None and worse >= self._sign * self.emergency:
            return Level.EMERGENCY
        if worse >= self._sign * self.critical:
            return Level.CRITICAL
        return Level.WARNING if worse >= self._sign * self.warning else Level.SAFE

    def scale(self, reading: Any) -> float:
        """Return the share of the velocity limit that a reading allows, from 0 to 1."""
        level = self.level(reading)
        if level is not Level.WARNING:
            return float(level is Level.SAFE)
        share = (float(reading) - self.warning) / (self.critical - self.warning)
        return 1 - (1 - self.slowest) * share


def _is_finite(value: Any) -> bool:
    """Return whether a value is a finite number, numpy's included; truth values are not."""
    try:
        return not isinstance(value, bool | str | bytes) and isfinite(value)
    except (TypeError, ValueError, OverflowError):
        return False
