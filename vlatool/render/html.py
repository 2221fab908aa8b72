"""The report as one HTML file: no script, no network, no font; light, dark, narrow and on paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vlatool.render import _sections as part
from vlatool.render._boards import KIND, by_state, chart
from vlatool.render._boards_html import boards_section, cost_section
from vlatool.render._columns import board
from vlatool.render._css import stylesheet
from vlatool.render._distribution import Sampled, beyond, distribution, left_out, sampled
from vlatool.render._format import label
from vlatool.render._measured_html import BARS, bars, percentile_section, trust
from vlatool.render._scatter import FOOTPRINT, points, scatter, upright
from vlatool.render._tables import details
from vlatool.render._timeline import MOST_GAUGES, along_the_run, gauges, over_time, throttled, timed, untimed
from vlatool.render._view import latency, measured_where
from vlatool.report import Report

WIDTHS = {"wide": 996, "narrow": 366}


class HtmlRenderer:
    """Writes one self-contained page, with charts as inline SVG."""

    def render(self, report: Report) -> str:
        """Return the page."""
        if report.kind == KIND:
            return self._page(
                report, part.head(report, trust(report)) + self._boards(report) + part.circumstances(report)
            )
        variants = sampled(report)
        body = "".join(
            (
                part.head(report, trust(report)),
                part.predicted(report) if board(report) else "",
                part.variants(report),
                percentile_section(report),
                self._spread(report, variants),
                self._over_time(report, timed(variants)),
                self._trade(report),
                bars(report),
                part.errors(report),
                part.others(report),
                part.tables(details(report, tuple(BARS))),
                "" if board(report) else part.predicted(report),
                self._along(report, untimed(variants)),
                part.circumstances(report),
            )
        )
        return self._page(report, body)

    def _boards(self, report: Report) -> str:
        found = "".join(boards_section(heading, rows) for heading, rows in by_state(report))
        known = [item for row in report.rows if (item := row.get("latency_p50", "predicted")) and item.known]
        if len(known) > 1:
            sub = "Down and to the left is better. Lines through the points are 80 % intervals; the dotted line joins "
            sub += "the boards that no other beats in both. Filled: fits or may fit. Hollow: ruled out."
            drawing = self._both(lambda width: chart(report, width))
            found += part.section("Price against latency", drawing, sub, "predicted")
        return found + cost_section(report)

    def _page(self, report: Report, body: str) -> str:
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f'<meta name="color-scheme" content="light dark"><title>{part.safe(report.title)}</title>'
            f"<style>{stylesheet()}</style></head>\n<body><main>{body}</main></body></html>\n"
        )

    def _spread(self, report: Report, variants: Sequence[Sampled]) -> str:
        if not variants:
            return ""
        aim = latency(report)
        sub = "Each curve climbs to the share of inferences that were at least as fast; dots: p50, p90, p99 if known. "
        sub += f"Below, the same samples as histograms with the same marks. {beyond(variants, aim.limit)} "
        drawing = self._both(lambda width: distribution(variants, aim, width))
        where = f"{measured_where(report)}. {sub}{left_out(report)}"
        return part.section("How latency is spread", drawing, where, "measured")

    def _trade(self, report: Report) -> str:
        found = points(report)
        if len(found) < 2:
            return ""
        name = upright(report)
        title = f"{label(name)} against {label(latency(report).name)}"
        better = "Down" if name in FOOTPRINT else "Up"
        sub = f"{better} and to the left is better. Lines through the points are intervals; the dotted line joins the "
        sub += "variants that no other beats in both. Square: baseline. Ringed: chosen. Hollow: outside the limits."
        drawing = self._both(lambda width: scatter(report, width))
        return part.section(part.capital(title), drawing, f"{measured_where(report)}. {sub}", "measured")

    def _over_time(self, report: Report, variants: Sequence[Sampled]) -> str:
        if not variants:
            return ""
        aim, most = latency(report), len(gauges(report)) - MOST_GAUGES
        sub = "Line: median of a stretch of time. Dark band: the middle 80 %. Light band: smallest to largest. "
        sub += "Each has its own scale, latency in ms; a band that touches the top goes beyond it. "
        sub += "Vertical lines: moments of throttling. " if throttled(report) else ""
        sub += f"{most} more gauges in report.json. " if most > 0 else ""
        drawing = self._both(lambda width: over_time(report, variants, aim, width))
        return part.section("Latency over time", drawing, f"{measured_where(report)}. {sub}", "measured")

    def _along(self, report: Report, variants: Sequence[Sampled]) -> str:
        if not variants:
            return ""
        aim = latency(report)
        sub = "Line: median of consecutive samples. Dark band: the middle 80 %. Light band: smallest to largest. "
        sub += "A slope means warming up or throttling. "
        sub += "Each variant has its own scale in ms; a band that touches the top goes beyond it. "
        sub += left_out(report)
        drawing = self._both(lambda width: along_the_run(variants, aim, width))
        return part.section("Latency along the run", drawing, f"{measured_where(report)}. {sub}", "measured")

    def _both(self, draw: Callable[[int], str]) -> str:
        return "".join(f'<div class="{css}">{draw(width)}</div>' for css, width in WIDTHS.items())
