"""Which rows are faster than others, and which of several would be chosen: by medians, speed-ups and ties."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from vlatool.measures.latency import LATENCY_P50, SPEEDUP
from vlatool.optimize.budget import distance_of
from vlatool.report import Row

TIE = 1.01
"""Candidates whose latencies differ by less are equally fast: two processes of one graph, in turns, differ by as much.
More would give speed away: with 5 % the search delivered what was 3 % slower than one of its own plans."""
MIN_RATIO = 1.005
"""Ratio of the medians from which on two decimals do not say 1.00."""
Item = TypeVar("Item")


def p50(row: Row, origin: str = "measured") -> float:
    """Return the median latency of a row in ms, infinite when it is not known."""
    latency = row.get(LATENCY_P50, origin)
    return latency.value if latency is not None and latency.known else math.inf


def ratio(row: Row, base: Row, origin: str = "measured") -> float:
    """Return how many times as fast a row is as another: its speed-up, or the quotient of medians; 0 when unknown."""
    if origin == "measured" and (speedup := row.get(SPEEDUP)) is not None and speedup.known:
        return speedup.value
    own, reference = p50(row, origin), p50(base, origin)
    return reference / own if 0 < own < math.inf and reference < math.inf else 0.0


def is_faster(row: Row, base: Row, origin: str = "measured") -> bool:
    """Say whether a row is faster than float32.

    Measured: the interval of the speed-up lies above 1, and the speed-up that is printed does not round to 1.00.
    Predicted: the prediction is; intervals of predictions for one board overlap, since they share their error.
    """
    if ratio(row, base, origin) < MIN_RATIO:
        return False
    speedup = row.get(SPEEDUP)
    return origin == "predicted" or (speedup is not None and speedup.low is not None and speedup.low > 1.0)


def first_choice(items: Sequence[Item], latency: Callable[[Item], float], loss: Callable[[Item], float]) -> Item:
    """Return the item with the smallest loss of those within ``TIE`` of the fastest; of equal ones the first."""
    least = min(map(latency, items))
    return min([item for item in items if latency(item) <= TIE * least] or items, key=loss)


def in_order(rows: Iterable[Row]) -> list[Row]:
    """Return candidates in the order in which they would be chosen if all kept to the limits.

    Of those that are as fast as the fastest that is left, the one nearest to float32 on recorded observations is first.
    """
    left, ordered = list(rows), []
    while left:
        ordered.append(first_choice(left, p50, _distance))
        left.remove(ordered[-1])
    return ordered


def _distance(row: Row) -> float:
    distance = distance_of(row)
    return distance.value if distance is not None and distance.known else math.inf
