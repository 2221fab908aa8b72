"""How far the slowest call is from the median."""

from __future__ import annotations

from vlatool.measures import Quantity
from vlatool.measures.latency import LATENCY_P50
from vlatool.measures.series import LATENCY
from vlatool.report import Measurement, Row


def tail_of(row: Row) -> Measurement | None:
    """Return the slowest call by the median; None for a row that was not timed."""
    calls, median = row.raw.get(LATENCY), row.get(LATENCY_P50)
    if not calls or median is None:
        return None
    return TAIL.measurement(max(calls) / median.value, samples=len(calls))


TAIL = Quantity("acme_tail", "x", "slowest call over median", better="less", order=45, of=tail_of)
