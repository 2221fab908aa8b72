"""Rows of a log and of a reference recording that are of the same moment, or a few steps apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlatool.data import Recording

MAX_DELAY = 3
"""Control steps by which a signal may come late, or early."""
MIN_PAIRS = 12
"""Pairs of rows from which a relation between two signals is taken."""
Indices = NDArray[np.int64]
Key = tuple[int, int]


@dataclass(frozen=True)
class Pairs:
    """Rows of the log, and for each the row of the reference ``delay`` steps before it."""

    log: Indices
    reference: Indices

    def __len__(self) -> int:
        return len(self.log)


def pair_rows(log: Recording, reference: Recording, control_hz: float | None) -> dict[int, Pairs]:
    """Return delay in control steps -> pairs, by time stamps where both have them, else by episode and step.

    Time stamps count in steps of the control loop, or of the reference where its rate is unknown. A delay is there with
    ``MIN_PAIRS`` pairs or more.
    """
    mine, theirs = _keys(log, reference, control_hz)
    if not mine or not theirs:
        return {}
    rows = {key: row for row, key in enumerate(theirs)}
    pairings = {delay: _pairs(mine, rows, delay) for delay in range(-MAX_DELAY, MAX_DELAY + 1)}
    return {delay: pairs for delay, pairs in pairings.items() if len(pairs) >= MIN_PAIRS}


def _pairs(keys: list[Key], rows: Mapping[Key, int], delay: int) -> Pairs:
    found = [(row, rows[before]) for row, (episode, step) in enumerate(keys)
             if (before := (episode, step - delay)) in rows]  # fmt: skip
    both = np.array(found, np.int64).reshape(-1, 2)
    return Pairs(both[:, 0], both[:, 1])


def _keys(log: Recording, reference: Recording, control_hz: float | None) -> tuple[list[Key], list[Key]]:
    """Return episode and step of each row of both; nothing when they cannot be of the same episodes."""
    if log.times is not None and reference.times is not None:
        hz = control_hz or _rate(reference.times)
        return _timed(log.times, hz), _timed(reference.times, hz)
    if log.episodes is not None and reference.episodes is not None:
        return _numbered(log.episodes), _numbered(reference.episodes)
    if len(log) != len(reference):
        return [], []
    episodes = next((each.episodes for each in (log, reference) if each.episodes is not None), np.zeros(len(log)))
    return _numbered(episodes), _numbered(episodes)


def _timed(times: NDArray[np.generic], hz: float) -> list[Key]:
    return [(0, round(float(time) * hz)) for time in times.tolist()]


def _rate(times: NDArray[np.generic]) -> float:
    """Return the rate in Hz at which rows were recorded, by the median of their distances."""
    distance = float(np.median(np.diff(times.astype(np.float64)))) if len(times) > 1 else 1.0
    return 1 / distance if distance > 0 else 1.0


def _numbered(episodes: NDArray[np.generic]) -> list[Key]:
    """Return for each row its stretch of one episode, and its place in that."""
    keys: list[Key] = []
    seen: dict[int, int] = {}
    for episode in episodes.tolist():
        step = seen.get(int(episode), 0)
        seen[int(episode)] = step + 1
        keys.append((int(episode), step))
    return keys
