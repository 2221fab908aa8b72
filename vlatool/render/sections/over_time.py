"""Latency over time, with what was read of the machine; in the order of the samples where their times are not known."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from vlatool.render._view import latency
from vlatool.render.charts.samples import left_out, sampled_variants
from vlatool.render.charts.timeline import MOST_GAUGES, along_the_run, gauges, over_time, throttle_times
from vlatool.render.document import Chart, Section
from vlatool.report import Report

BANDS = "Dark band: the middle 80 %. Light band: smallest to largest."


class OverTime:
    """Two drawings: with times, and without."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return a section for the variants whose times are known, and one for the others."""
        variants, aim = sampled_variants(report), latency(report)
        if timed := [variant for variant in variants if variant.times]:
            more = len(gauges(report)) - MOST_GAUGES
            caption = f"Line: median of a stretch of time. {BANDS} Each has its own scale, latency in ms; a band that "
            caption += "touches the top goes beyond it."
            caption += " Vertical lines: moments of throttling." if throttle_times(report) else ""
            caption += f" {more} more gauges in report.json." if more > 0 else ""
            drawing = Chart(partial(over_time, report, timed, aim), caption)
            yield Section("Latency over time", (drawing,), 50, "measured")
        if untimed := [variant for variant in variants if not variant.times]:
            caption = f"Line: median of consecutive samples. {BANDS} A slope means warming up or throttling. Each "
            caption += (
                f"variant has its own scale in ms; a band that touches the top goes beyond it. {left_out(report)}"
            )
            drawing = Chart(partial(along_the_run, untimed, aim), caption.strip())
            yield Section("Latency along the run", (drawing,), 120, "measured")
