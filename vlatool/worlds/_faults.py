"""Faults of simulated sensors: delay, loss and freezing of what they send."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from vlatool.errors import UsageError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time

LARGEST = {"drop": 1.0, "freeze": 1.0}
"""Knob that is a share -> its largest value."""


def read_knob(name: str, text: str, sensors: Collection[str]) -> dict[str, float]:
    """Return a knob that each sensor has: sensor -> number.

    Args:
        name: Name of the knob.
        text: A number for all sensors, or ``SENSOR=NUMBER`` separated by commas; 0 for those that are absent.
        sensors: Known sensors.

    Raises:
        UsageError: for an unknown sensor, or what is not a number from 0 to that of ``LARGEST``.
    """
    values: dict[str, float] = {}
    most = LARGEST.get(name, 1e6)
    for part in filter(None, (piece.strip() for piece in str(text).split(","))):
        sensor, equals, number = part.partition("=")
        if equals and sensor not in sensors:
            raise UsageError.unknown(f"Unknown sensor '{sensor}' in {name}", sensor, sensors)
        try:
            value = float(number if equals else sensor)
        except ValueError:
            value = -1.0
        if not 0.0 <= value <= most:
            raise UsageError(
                f"{name} has '{part}'; allowed: a number from 0 to {most:g}, or SENSOR=NUMBER separated by commas.",
                f"write for example {name}='0.1' or {name}='{next(iter(sensors))}=0.1'",
            )
        values.update({sensor: value} if equals else dict.fromkeys(sensors, value))
    return values


class Outbox:
    """Messages of sensors on their way to whoever reads them.

    Args:
        delay: Sensor -> seconds until a message arrives.
        drop: Sensor -> share of its messages that are lost.
        freeze: Sensor -> share of them from which on, for half a second, the content of that one is sent again, with
            new stamps.
        random: Source of chance.
    """

    FROZEN_S = 0.5

    def __init__(
        self, delay: Mapping[str, float], drop: Mapping[str, float], freeze: Mapping[str, float],
        random: np.random.Generator,
    ) -> None:  # fmt: skip
        self._delay, self._drop, self._freeze, self._random = delay, drop, freeze, random
        self._waiting: list[tuple[float, str, Message]] = []
        self._frozen: dict[str, tuple[float, Message]] = {}

    def put(self, sensor: str, topic: str, message: Message, now_s: float) -> None:
        """Send a message of a sensor."""
        until, content = self._frozen.get(sensor, (-1.0, message))
        if now_s < until:
            message = _stamped_as(content, message)
        elif self._chance(self._freeze, sensor):
            self._frozen[sensor] = (now_s + self.FROZEN_S, message)
        if not self._chance(self._drop, sensor):
            self._waiting.append((now_s + self._delay.get(sensor, 0.0), topic, message))

    def _chance(self, shares: Mapping[str, float], sensor: str) -> bool:
        share = shares.get(sensor, 0.0)
        return bool(share and self._random.random() < share)

    def take(self, now_s: float) -> list[tuple[str, Message]]:
        """Return what arrived until now, in the order in which it was sent."""
        ready = [(topic, message) for when, topic, message in self._waiting if when <= now_s + 1e-9]
        self._waiting = [entry for entry in self._waiting if entry[0] > now_s + 1e-9]
        return ready


def _stamped_as(content: Message, message: Message) -> Message:
    """Return a message with the stamp of another."""
    header: Any = getattr(message, "header", None)
    return content if header is None else dataclasses.replace(content, header=header)  # type: ignore[type-var]


def time_of(seconds: float) -> Time:
    """Return the stamp of simulated time."""
    return Time.from_seconds(seconds)
