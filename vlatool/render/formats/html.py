"""The report as one HTML file: no script, no network, no font; light, dark, narrow and on paper.

``page.html`` draws a document, ``page.css`` beside it is its style. jinja2 escapes all that the template prints; a
drawing is the one thing that is not escaped again, since a canvas has escaped what is in it.
"""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING, Any

from vlatool.errors import require
from vlatool.render._format import plain
from vlatool.render._view import measured_where
from vlatool.render.document import Chart, build
from vlatool.report import Report

if TYPE_CHECKING:
    from jinja2 import Template

WIDTHS = {"wide": 996, "narrow": 366}
MARKS = {"pass": "✓ ", "fail": "✕ ", "inconclusive": "? ", "info": ""}
MOST_LINES = 200


class HtmlRenderer:
    """Writes one self-contained page, with charts as inline SVG."""

    def render(self, report: Report) -> str:
        """Return the page; raises MissingExtra when jinja2 is not installed."""
        where = measured_where(report)
        return template().render(document=build(report), where=where[:1].lower() + where[1:]) + "\n"


@cache
def template() -> Template:
    """Return the page's template, compiled once."""
    jinja2 = require("jinja2", "build")
    markup = require("markupsafe", "build").Markup

    def printable(content: Any) -> Any:
        """Take control characters out of every text; drawings are as they are."""
        return plain(content) if isinstance(content, str) and not isinstance(content, markup) else content

    files = jinja2.PackageLoader("vlatool.render.formats", "")
    environment = jinja2.Environment(autoescape=True, finalize=printable, loader=files)
    environment.filters.update(
        percent=lambda share: f"{100 * min(1.0, max(0.0, share)):.1f}%",
        capital=lambda text: text[:1].upper() + text[1:],
        pieces=lambda text: re.split(r"(?<=[_\-./])", text),
        drawn=_drawn,
    )
    environment.globals.update(widths=WIDTHS, marks=MARKS, most=MOST_LINES)
    page: Template = environment.get_template("page.html")
    return page


def _drawn(chart: Chart, width: int) -> Any:
    return require("markupsafe", "build").Markup(chart.draw(width).svg())
