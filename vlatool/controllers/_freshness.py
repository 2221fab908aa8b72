"""How old what a sensor says is: since it came, or since its stamp last changed, or by its stamp."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from vlatool.controllers._interface import Snapshot
from vlatool.messages.builtin_interfaces import Time

CLOCK_STEP_S = 10.0
"""Age by stamps from which it says that a clock was set, and nothing of the sensor, in seconds."""


class Change(NamedTuple):
    """The last change of an input: the stamp that came, and when, in seconds of ``Snapshot.time_s``."""

    stamp: tuple[int, int]
    time_s: float


Changes = Mapping[str, Change]


def note_changes(snapshot: Snapshot, inputs: Iterable[str], known: Changes) -> dict[str, Change]:
    """Return when the newest message of each input first came with its stamp; a sensor that repeats itself ages.

    A message without a stamp, or with a stamp of zero, is new each time.
    """
    changes = dict(known)
    for name in inputs:
        reading = snapshot.newest.get(name)
        if reading is None:
            continue
        stamp = stamp_of(reading.message)
        pair = (stamp.sec, stamp.nanosec)
        if name not in changes or pair != changes[name].stamp or pair == (0, 0):
            changes[name] = Change(pair, reading.received_s)
    return changes


def stamp_of(message: Any) -> Time:
    """Return the stamp of a message; zero where it has none."""
    header = getattr(message, "header", None)
    return header.stamp if header is not None else Time()


def age_s(snapshot: Snapshot, name: str, changes: Changes) -> float:
    """Return the age of an input in seconds; infinity where nothing has come.

    By its stamp, where that is less than ``CLOCK_STEP_S`` old: a stamp of tomorrow, or of an hour ago, is that of
    another clock.
    """
    if name not in changes:
        return float("inf")
    stamp, changed_s = changes[name]
    since = snapshot.time_s - changed_s
    by_stamp = snapshot.stamp.sec - stamp[0] + (snapshot.stamp.nanosec - stamp[1]) * 1e-9
    return max(since, by_stamp) if stamp != (0, 0) and 0.0 < by_stamp < CLOCK_STEP_S else since
