"""How the latencies are spread: every sample as a curve and a histogram."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from vlatool.measures.latency import LATENCY_P99
from vlatool.measures.series import LATENCY
from vlatool.render._columns import board
from vlatool.render._format import count, plain
from vlatool.render._view import latency, percentiles
from vlatool.render.cells import number, texts
from vlatool.render.charts.distribution import beyond, distribution
from vlatool.render.charts.samples import finite, left_out, sampled_variants, sparkline
from vlatool.render.document import Cell, Chart, Column, Line, Section, Table
from vlatool.report import Report

HELP = (
    "Each curve climbs to the share of inferences that were at least as fast; dots: p50, p90, p99 if known. "
    "Below, the same samples as histograms with the same marks."
)


class Spread:
    """The distribution of the samples."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the drawing, with a line of blocks for each variant in its place."""
        if variants := sampled_variants(report):
            aim = latency(report)
            caption = " ".join(part for part in (HELP, beyond(variants, aim.limit), left_out(report)) if part)
            drawing = Chart(partial(distribution, variants, aim), caption, _blocks(report))
            yield Section("How latency is spread", (drawing,), 40, "measured")


def _blocks(report: Report) -> Table:
    known = any((tail := row.get(LATENCY_P99)) and tail.known for row in report.rows)
    tails = known and not percentiles(report)
    lines = []
    for row in report.rows:
        samples = finite(row.raw.get(LATENCY) or [])
        if len(samples) > 1:
            tail = row.get(LATENCY_P99) if tails else None
            last = number(tail) if tail else Cell(count(len(samples)))
            lines.append(Line((*texts((plain(row.name), sparkline(samples, 20))), last)))
    where = ", this host" if board(report) else ""
    heads = (Column(f"spread of latency{where}", False), Column("min … p99", False))
    return Table((*heads, Column("latency p99" if tails else "calls")), tuple(lines))
