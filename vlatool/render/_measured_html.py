"""What a benchmark adds to the HTML page: whether to trust it, percentiles, and bars by part and phase."""

from __future__ import annotations

import math
from typing import Any

from vlatool.render._format import plain
from vlatool.render._percentiles import Percentiles, percentiles
from vlatool.render._sections import breakable, capital, safe, section
from vlatool.render._svg import series
from vlatool.render._tables import column_texts
from vlatool.render._trust import findings, reason, remedy, sentence
from vlatool.render._view import measured_where
from vlatool.report import Report

BARS = {"memory by part": "MB", "time by phase": "share %", "cold start by part": "ms"}
"""Title of a details table -> the column of which bars are drawn."""


def trust(report: Report) -> str:
    """Return whether the measurement can be trusted, each reason with its remedy."""
    items = "".join(
        f'<li><b class="{found.effect}">{found.effect}</b> {safe(reason(found))}'
        + (f' <span class="remedy">{safe(remedy(found))}</span>' if remedy(found) else "")
        + "</li>"
        for found in findings(report)
    )
    told = f"<p>{safe(sentence(report))}</p>" if report.validity else ""
    listed = f"<ul>{items}</ul>" if items else ""
    return f'<div class="trust {report.validity or "note"}">{told}{listed}</div>' if told or listed else ""


def percentile_section(report: Report) -> str:
    """Return the percentiles of the latency, a value and its bound for each variant."""
    found = percentiles(report)
    if found is None:
        return ""
    tints = dict(zip((plain(row.name) for row in report.rows), series(report.rows), strict=True))
    each = 2 if found.bounded else 1
    several = len(found.variants) > 1
    names = "".join(
        f'<th scope="colgroup" class="n" colspan="{each}"><span class="key {tints[name]}"></span>{breakable(name)}</th>'
        for name in found.variants
    )
    titles = '<th scope="col" class="n begin">ms</th>' + (
        f'<th scope="col" class="n">{safe(found.bound)}</th>' if found.bounded else ""
    )
    top = f'<tr class="over"><td></td>{names}</tr>' if several else ""
    lines = "".join(_line(found, place, each) for place in range(len(found.names)))
    table = (
        f'<table class="percentiles"><thead>{top}<tr><th scope="col">Percentile</th>'
        f"{titles * len(found.variants)}</tr></thead><tbody>{lines}</tbody></table>"
    )
    sub = f"{measured_where(report)}. {found.about()}"
    if found.bounded and "most" in found.bound:
        sub += " The second number is an upper bound of the percentile, at that confidence."
    return section("Latency percentiles", f'<div class="scroll">{table}</div>', sub, "measured")


def _line(found: Percentiles, place: int, each: int) -> str:
    cells = []
    name = f'<th scope="row">{safe(found.names[place])}</th>'
    told = set(found.reasons[place])
    if len(told) == 1 and (same := told.pop()):
        return f'<tr>{name}<td class="n why" colspan="{each * len(found.variants)}">{safe(same)}</td></tr>'
    for value, bound, why in zip(found.values[place], found.bounds[place], found.reasons[place], strict=True):
        if why:
            cells.append(f'<td class="n why begin" colspan="{each}">{safe(why)}</td>')
        else:
            beside = f'<td class="n bound">{safe(bound) or "–"}</td>' if found.bounded else ""
            cells.append(f'<td class="n begin">{safe(value)}</td>{beside}')
    return f"<tr>{name}{''.join(cells)}</tr>"


def bars(report: Report) -> str:
    """Return memory by part, time by phase and cold start by part: every number, and a bar beside it."""
    body = "".join(_bars(report, title, key) for title, key in BARS.items())
    sub = f"{measured_where(report)}. Bars begin at zero and share a scale within a table."
    return section("Where memory and time go", body, sub, "measured") if body else ""


def _bars(report: Report, title: str, key: str) -> str:
    records: list[tuple[str, str, dict[str, Any]]] = [
        (row.name, css, dict(record))
        for row, css in zip(report.rows, series(report.rows), strict=True)
        for record in row.details.get(title, ())
        if record
    ]
    if not records:
        return ""
    first = next(iter(records[0][2]))
    order = list(dict.fromkeys(str(record.get(first)) for _, _, record in records))
    records.sort(key=lambda item: order.index(str(item[2].get(first))))
    columns = list(dict.fromkeys(name for _, _, record in records for name in record if name != first))
    texts = [column_texts([record.get(name) for _, _, record in records]) for name in columns]
    kinds = ["n calls" if name == "calls" else "n" for name in columns]
    several = len({name for name, _, _ in records}) > 1
    top = max((_size(record.get(key)) for _, _, record in records), default=0.0)
    lines, last = [], ""
    for place, (name, css, record) in enumerate(records):
        part = str(record.get(first))
        shown = safe(part) if part != last else ""
        last, begins = part, part != last
        whose = f'<td class="whose"><span class="key {css}"></span>{safe(name)}</td>' if several else ""
        numbers = "".join(
            f'<td class="{css_of}">{safe(column[place])}</td>' for css_of, column in zip(kinds, texts, strict=True)
        )
        share = 100 * _size(record.get(key)) / top if top > 0 else 0.0
        drawn = f'<td><span class="bar {css}" aria-hidden="true"><i style="width:{share:.1f}%"></i></span></td>'
        lines.append(f"<tr{'' if begins else SAME}><td>{shown}</td>{whose}{numbers}{drawn}</tr>")
    heads = "".join(
        f'<th scope="col" class="{css_of}">{safe(name)}</th>' for css_of, name in zip(kinds, columns, strict=True)
    )
    variant = '<th scope="col">variant</th>' if several else ""
    top_line = f'<tr><th scope="col">{safe(first)}</th>{variant}{heads}<td></td></tr>'
    return (
        f'<h3>{safe(capital(title))}</h3><div class="scroll"><table class="groups parts"><thead>{top_line}</thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


SAME = ' class="same"'


def _size(content: Any) -> float:
    number = isinstance(content, int | float) and not isinstance(content, bool)
    return float(content) if number and math.isfinite(content) and content > 0 else 0.0
