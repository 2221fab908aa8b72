"""What a dataset holds: episodes, rates, shapes, gaps, values that are not finite, cameras whose clocks drift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.data._lazy_rows import LazyRows
from vlatool.data._recording import Values
from vlatool.data._steps import Steps
from vlatool.files.printable import amount
from vlatool.files.rows import blocks

Array = NDArray[Any]
GAP = 1.5
"""Periods of the rate between two steps from which a step is missing."""
RATE_TOLERANCE = 0.05
"""Share by which a measured rate may differ from the one that a dataset names."""
MAX_DRIFT_S = 0.02
"""Seconds by which the lag of a camera may change within an episode."""
SHORT_EPISODE = 0.1
"""Share of the usual length below which an episode is mentioned."""
MAX_LISTED = 8


@dataclass(frozen=True)
class Column:
    """One column.

    Args:
        shape: of a row.
        low, high: of its numbers; None of pictures and texts.
        not_finite: rows that hold NaN or infinity; pictures are not looked at.
        constant: elements that never change.
        drift_ms: largest change of its lag within an episode; None where it has no times of its own.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    low: float | None = None
    high: float | None = None
    not_finite: int = 0
    constant: tuple[int, ...] = ()
    drift_ms: float | None = None


@dataclass(frozen=True)
class Gap:
    """A place where time does not go on as it should.

    Args:
        step: number of the step in its episode before which it is.
    """

    episode: int
    step: int
    seconds: float


@dataclass(frozen=True)
class Inspection:
    """What a dataset holds.

    Args:
        hz: rate that it names; 0 where it names none.
        measured_hz: median over the steps; None without time stamps.
        lengths: steps of each episode.
        gaps: the largest; ``gap_count`` counts all.
        findings: sentences on what is likely to be wrong.
    """

    path: str
    format: str
    episodes: int
    steps: int
    hz: float
    measured_hz: float | None
    lengths: tuple[int, ...]
    tasks: int
    action: str
    columns: tuple[Column, ...]
    gaps: tuple[Gap, ...]
    gap_count: int
    findings: tuple[str, ...]


def inspect_steps(steps: Steps, kind: str) -> Inspection:
    """Go through a dataset once, but for its pictures.

    Args:
        kind: name of its format.
    """
    firsts = np.concatenate([[0], np.flatnonzero(np.diff(steps.episodes)) + 1])
    lengths = np.diff(np.append(firsts, len(steps)))
    columns = tuple(_column(name, values, steps, firsts) for name, values in steps.columns.items())
    period, gaps = _gaps(steps, firsts)
    found = _findings(steps, columns, period, gaps, lengths)
    largest = tuple(sorted(gaps, key=lambda gap: -abs(gap.seconds))[:MAX_LISTED])
    return Inspection(
        str(steps.path), kind, len(lengths), len(steps), steps.hz, 1 / period if period else None,
        tuple(map(int, lengths)), 0 if steps.tasks is None else len(np.unique(steps.tasks)), steps.action, columns,
        largest, len(gaps), (*steps.notes, *found),
    )  # fmt: skip


def _column(name: str, values: Values, steps: Steps, firsts: Array) -> Column:
    drift = (
        _drift(steps.stamps[name], steps.times, firsts) if name in steps.stamps and steps.times is not None else None
    )
    shape = tuple(map(int, values.shape[1:]))
    if isinstance(values, LazyRows) or values.dtype.kind not in "iufb":
        return Column(name, str(values.dtype), shape, drift_ms=drift)
    low, high, wrong = np.inf, -np.inf, 0
    first = np.asarray(values[0])
    same = np.ones(first.shape, np.bool_)
    for _, block in blocks(values):
        finite = np.isfinite(block)
        wrong += int((~finite.reshape(len(block), -1).all(axis=1)).sum())
        if finite.any():
            low, high = min(low, float(block[finite].min())), max(high, float(block[finite].max()))
        same &= (block == first).all(axis=0)
    constant = tuple(np.flatnonzero(same).tolist()) if same.ndim <= 1 else ()
    lowest, highest = (low, high) if low <= high else (None, None)
    return Column(name, str(values.dtype), shape, lowest, highest, wrong, constant, drift)


def _drift(stamps: Array, times: Array, firsts: Array) -> float:
    """Return the largest change of a lag within an episode, from its first tenth to its last, in ms."""
    changes = [0.0]
    for lag in np.split(stamps - times, firsts[1:]):
        part = max(1, len(lag) // 10)
        changes.append(abs(float(np.median(lag[-part:]) - np.median(lag[:part]))) * 1000)
    return max(changes)


def _gaps(steps: Steps, firsts: Array) -> tuple[float, list[Gap]]:
    """Return the median period in seconds, and each place where time jumps, stands still or goes back."""
    if steps.times is None or len(steps) < 2:
        return 0.0, []
    differences = np.diff(steps.times)
    inside = np.ones(len(differences), np.bool_)
    inside[firsts[1:] - 1] = False
    if not inside.any():
        return 0.0, []
    period = float(np.median(differences[inside]))
    wrong = np.flatnonzero(inside & ~((differences > 0) & (differences < GAP * max(period, 1e-9)))) + 1
    episode = np.searchsorted(firsts, wrong, side="right") - 1
    places = zip(wrong, episode, strict=True)
    gaps = [Gap(int(steps.episodes[row]), int(row - firsts[at]), float(differences[row - 1])) for row, at in places]
    return max(period, 0.0), gaps


def _findings(steps: Steps, columns: tuple[Column, ...], period: float, gaps: list[Gap], lengths: Array) -> list[str]:
    found = []
    if gaps:
        worst = max(gaps, key=lambda gap: abs(gap.seconds))
        found.append(
            f"{amount(len(gaps), 'gap')}: time goes on by {worst.seconds:.3f} s before step {worst.step} of episode "
            f"{worst.episode}, otherwise by {period:.3f} s"
        )
    if period and steps.hz and abs(1 / period / steps.hz - 1) > RATE_TOLERANCE:
        found.append(f"the dataset names {steps.hz:g} Hz; its time stamps are those of {1 / period:.3g} Hz")
    found += [
        f"'{each.name}' is not finite in {amount(each.not_finite, 'step')}" for each in columns if each.not_finite
    ]
    for each in columns:
        if each.constant:
            listed = ", ".join(map(str, each.constant[:MAX_LISTED]))
            found.append(f"'{each.name}' never changes in element {listed}")
        if (each.drift_ms or 0) > MAX_DRIFT_S * 1000:
            found.append(f"the lag of '{each.name}' changes by {each.drift_ms:.0f} ms within an episode")
    shortest, usual = int(lengths.min()), int(np.median(lengths))
    if shortest < SHORT_EPISODE * usual:
        episode = int(steps.episodes[np.cumsum(lengths)[lengths.argmin()] - 1])
        found.append(f"episode {episode} has {amount(shortest, 'step')}; half of them have {usual} or more")
    if not steps.action:
        found.append("no column of actions was found; --map action=NAME names it")
    return found
