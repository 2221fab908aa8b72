"""What right logs have for a change by chance: episodes of a reference, judged by models that do not know them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vlatool.stats.intervals import student
from vlatool.verify._search import DELAY_KIND, KINDS, Tables, search
from vlatool.verify._series import Series
from vlatool.verify._views import folds

MAX_FOLDS, EPISODE_FOLDS = 16, 4
"""Parts of a reference that are left out in turn: whole tasks, or some episodes of each task."""
MIN_LOG = 50
"""Rows of the reference, of whole episodes, that are judged as if they were a log: in fewer, nothing is found."""
ALARM = 1e-3
"""Share of right logs in which a kind of change of a signal may be found."""
MIN_EVIDENCE = float(np.log(1 / ALARM))
ROWS_RATIO = 1.5
"""A log is judged as those of the next number of episodes if that has at most so many times its rows."""
SIZES, MAX_LOGS, MIN_SIZE_LOGS = (1, 2, 4), 12, 12
"""Episodes of a log that is judged; logs of several that each part gives, and that all need to give."""
Needed = Mapping[str, dict[str, float]]
"""Signal -> kind of change -> what must speak for it, so that it is not found in a right log."""
Part = tuple[NDArray[np.bool_], list[list[int]]]
"""Which rows are left out together, and episodes among them of ``MIN_LOG`` rows or more, of which a log is."""


@dataclass(frozen=True)
class Bounds:
    """What must speak for a change in logs of different lengths.

    Args:
        by_size: number of episodes -> what is needed.
        rows: of an episode, on average.
    """

    by_size: Mapping[int, Needed]
    rows: float

    def with_delays_of(self, other: Bounds) -> Bounds:
        """Return bounds of which those of delays are as high as others.

        By how much an image seems to be ahead of its sensors differs from task to task by a part of a control step, of
        which episodes of the same tasks tell too little.
        """
        found = {
            size: {name: each | {DELAY_KIND: max(each[DELAY_KIND], other.by_size[size][name][DELAY_KIND])}
                   for name, each in signals.items()} if size in other.by_size else signals
            for size, signals in self.by_size.items()
        }  # fmt: skip
        return Bounds(found, self.rows)

    def threshold(self, rows: int) -> Needed:
        """Return what is needed in a log of so many rows.

        Beyond the longest that was judged, what a right log has because predictions are not exact grows with its rows,
        and what it has by chance with their root: residuals hang together over more rows than the regression knows.
        """
        size = max(size for size in self.by_size if size == 1 or size * self.rows <= ROWS_RATIO * rows)
        least = MIN_EVIDENCE * size**0.5
        longer = max(1.0, rows / (size * self.rows))
        return {
            name: {kind: least * longer**0.5 + longer * (value - least) for kind, value in each.items()}
            for name, each in self.by_size[size].items()
        }


@dataclass(frozen=True, eq=False)
class Nulls:
    """Evidence that right logs have: (number of episodes, signal, kind of change) -> of each log."""

    found: dict[tuple[int, str, str], list[float]] = field(default_factory=dict)

    def add(self, logs: Sequence[Mapping[str, Tables]], images: Sequence[str]) -> None:
        """Judge logs of one episode and of several, whose evidence is that of the episodes together."""
        for size in SIZES:
            for chosen in _spread(list(itertools.combinations(logs, size)), MAX_LOGS if size > 1 else len(logs)):
                for name in chosen[0]:
                    together = Tables.sum_of([tables[name] for tables in chosen])
                    parts = search(together, dict.fromkeys(KINDS, 0.0), only_delay=name in images).components
                    for kind in KINDS:
                        value = max((each.evidence for each in parts if each.kind == kind), default=0.0)
                        self.found.setdefault((size, name, kind), []).append(value)

    def bounds(self, names: Sequence[str], rows: float, *others: Nulls) -> Bounds:
        """Return what is needed so that none of these logs, nor of others, would be called wrong."""
        every = (self, *others)
        sizes = [size for size in SIZES if size == 1 or self._count(size, names) >= MIN_SIZE_LOGS]
        return Bounds({size: {name: {kind: max(each._bound(size, name, kind) for each in every) for kind in KINDS}
                              for name in names} for size in sizes}, rows)  # fmt: skip

    def _count(self, size: int, names: Sequence[str]) -> int:
        return min((len(self.found.get((size, name, kind), ())) for name in names for kind in KINDS), default=0)

    def _bound(self, size: int, name: str, kind: str) -> float:
        return upper_bound(self.found.get((size, name, kind), ()), MIN_EVIDENCE * size**0.5)


def _spread(logs: Sequence[tuple[Mapping[str, Tables], ...]], most: int) -> Iterator[tuple[Mapping[str, Tables], ...]]:
    """Yield some combinations, spread over all of them."""
    if logs:
        yield from (logs[int(at)] for at in np.unique(np.linspace(0, len(logs) - 1, most).astype(int)))


def upper_bound(values: Sequence[float], least: float = MIN_EVIDENCE) -> float:
    """Return what another right log exceeds with the chance ``ALARM``, and no value here does.

    The bound of Student's distribution for one more value of a normal sample; without a sample that of likelihood
    ratios, of which a right log exceeds ``log(1 / ALARM)`` with the chance ``ALARM`` at most.
    """
    if len(values) < 2:
        return 2 * least
    spread = float(np.std(values, ddof=1)) * math.sqrt(1 + 1 / len(values))
    return max(least, *values, float(np.mean(values)) + student(1 - ALARM, len(values) - 1) * spread)


def task_parts(series: Series) -> Iterator[Part]:
    """Yield whole tasks: their episodes are judged by a model that does not know the task."""
    yield from _parts(series, folds(series.groups, MAX_FOLDS))


def episode_parts(series: Series) -> Iterator[Part]:
    """Yield some episodes of each task, of which others are left."""
    order, lone = np.zeros(len(series), np.int64), np.zeros(len(series), bool)
    for group in np.unique(series.groups):
        rows = series.groups == group
        numbers, order[rows] = np.unique(series.episodes[rows], return_inverse=True)
        lone[rows] = len(numbers) == 1
    parts = min(EPISODE_FOLDS, int(order.max()) + 1)
    yield from _parts(series, [(order % parts == part) & ~lone for part in range(parts)])


def _parts(series: Series, left_out: Iterable[NDArray[np.bool_]]) -> Iterator[Part]:
    for out in left_out:
        if out.all() or not out.any():
            continue
        logs: list[list[int]] = [[]]
        for number in np.unique(series.episodes[out]).tolist():
            logs[-1].append(number)
            if np.isin(series.episodes, logs[-1]).sum() >= MIN_LOG:
                logs.append([])
        yield out, [each for each in logs if each]
