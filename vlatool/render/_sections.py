"""The parts of the HTML page: the verdict, the variants, what was measured and predicted, and how."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape

from vlatool.render._columns import Column, about, columns, sides
from vlatool.render._format import aside, label, limit, plain, quantity, span
from vlatool.render._svg import series
from vlatool.render._tables import Table
from vlatool.render._view import (
    brackets,
    dimension,
    error_groups,
    facts,
    latency,
    matrix,
    measured_where,
    names,
    notes,
    other_names,
    percentile_names,
    place,
    places,
    role,
    unmeasured,
)
from vlatool.report import Measurement, Report, Row

MARKS = {"pass": "✓", "fail": "✕", "inconclusive": "?", "info": ""}
MOST_RECORDS = 200


def safe(content: object) -> str:
    """Return text that is safe in HTML, in attributes too."""
    return escape(plain(content))


def section(title: str, body: str, sub: str = "", kind: str = "", css: str = "", ident: str = "") -> str:
    """Return a section with a heading; ``kind`` says whether its numbers were measured or predicted."""
    tag = f'<span class="kind">{kind}</span>' if kind else ""
    below = f'<p class="sub">{safe(sub)}</p>' if sub else '<p class="sub"></p>'
    attributes = (f' class="{css}"' if css else "") + (f' id="{ident}"' if ident else "")
    return f"<section{attributes}><h2>{tag}{safe(title)}</h2>{below}{body}</section>"


def head(report: Report, trust: str = "") -> str:
    """Return title, verdict, summary, whether the measurement can be trusted, and limits."""
    made = " · ".join(part for part in (f"vlatool {report.kind} report", report.created) if part)
    first, *more = report.summary or (report.title,)
    badge = f'<span class="badge {report.verdict}">{f"{MARKS[report.verdict]} {report.verdict}".strip()}</span>'
    parts = [f'<header><div class="over">{safe(made)}</div><h1>{safe(report.title)}</h1>']
    parts.append(f'<div class="result">{badge}<p>{safe(first)}</p></div>')
    parts.append(_sides(report))
    parts += [f"<p>{safe(sentence)}</p>" for sentence in more]
    parts.append(trust)
    if report.limits:
        asked = [limit(name, wanted) for name, wanted in report.limits.items()]
        items = "".join(f"<li><span>{safe(name)}</span> {safe(wanted)}</li>" for name, wanted in asked)
        parts.append(
            f'<ul class="limits" aria-label="limits asked for"><li><span>limits asked for</span></li>{items}</ul>'
        )
    if report.warnings:
        many = f"{len(report.warnings)} warnings" if len(report.warnings) > 1 else "1 warning"
        parts.append(f'<p class="sub"><a href="#warnings">{many}</a> to read before trusting the numbers.</p>')
    return "".join([*parts, "</header>"])


def _sides(report: Report) -> str:
    """Return what was measured here beside what is predicted for the board; nothing without a board."""
    found = sides(report)
    if found is None:
        return ""
    here = measured_where(report).replace("Measured", "measured", 1)
    return (
        f'<div class="sides" aria-label="{safe(found.name)}: measured and predicted">'
        + _side("measured", f"{found.name}, {here}", found.measured)
        + _side("predicted", f"{found.name}, on {found.board}: not measured there", found.predicted)
        + "</div>"
    )


def _side(kind: str, title: str, told: Sequence[tuple[str, str]]) -> str:
    pairs = "".join(f"<div><dt>{safe(name)}</dt><dd>{safe(text)}</dd></div>" for name, text in told)
    css = ' class="guess"' if kind == "predicted" else ""
    return f'<div{css}><p><span class="kind">{kind}</span>{safe(title)}</p><dl>{pairs}</dl></div>'


def variants(report: Report) -> str:
    """Return the headline table: one variant a row, its reason below."""
    shown = columns(report)
    if not report.rows:
        return section("Variants", "<p>The report has no rows.</p>")
    heads = "".join(
        f'<th scope="col" role="columnheader"{_n(column.name)}>{safe(capital(column.title))}</th>' for column in shown
    )
    top = max((_reach(row.get("latency_p50")) for row in report.rows), default=0.0)
    aim = latency(report)
    mark = aim.limit if aim.name == "latency_p50" and aim.limit is not None and aim.limit < 2.5 * top else None
    top = max(top, mark or 0.0)
    bodies = "".join(
        _variant(row, css, shown, top, mark, report) for row, css in zip(report.rows, series(report.rows), strict=True)
    )
    table = (
        '<table class="variants" role="table"><thead role="rowgroup"><tr role="row">'
        '<th scope="col" role="columnheader">'
        f"Variant</th>{heads}</tr></thead>{bodies}</table>"
    )
    return section(
        "Variants",
        f'<div class="scroll">{table}</div>',
        " ".join(part for part in (f"{measured_where(report)}.", about(report), brackets(report, "measured")) if part),
        "measured",
    )


def _without_count(item: Measurement | None, row: Row) -> Measurement | None:
    """Drop the count of a speed-up when it is that of the latencies beside it."""
    beside = row.get("latency_p50")
    same = item is not None and beside is not None and item.samples == beside.samples
    return replace(item, samples=0) if same and item is not None else item


def _n(name: str, item: Measurement | str | None = "") -> str:
    words = [*([] if name == "latency_p50" else ["n"]), *(["gap"] if item is None else [])]
    return f' class="{" ".join(words)}"' if words else ""


def _reach(item: Measurement | None) -> float:
    if item is None:
        return 0.0
    return max((value for value in (item.value, item.high or 0.0) if math.isfinite(value)), default=0.0)


def _variant(row: Row, css: str, shown: Sequence[Column], top: float, mark: float | None, report: Report) -> str:
    several = len(places(report, "measured")) > 1
    cells = []
    for column in shown:
        name, item = column.name, column.of(row)
        content = value_cell(_without_count(item, row) if name == "speedup" else item)
        if item is not None and name == "latency_p50":
            content += bar(item, top, css, mark)
            tail = row.get("latency_p99")
            content += (
                _small(f"p99 {quantity(tail)}" + (f" ({span(tail)})" if span(tail) else ""))
                if tail is not None and tail.known
                else ""
            )
        if item is not None and several:
            content += f'<span class="aside">{safe(place(report, item.where))}</span>'
        cells.append(f'<td role="cell" data-label="{safe(column.title)}"{_n(name, item)}>{content}</td>')
    name_cell = f'<th scope="row" role="rowheader"><span class="key {css}"></span>{breakable(row.name)}</th>'
    why = f'<span class="role">{safe(role(row))}</span>{": " + safe(row.reason) if row.reason else ""}'
    if row.role == "subject":
        why = safe(row.reason)
    body = ' class="chosen-row"' if row.role == "chosen" else ""
    return (
        f'<tbody{body} role="rowgroup"><tr role="row">{name_cell}{"".join(cells)}</tr>'
        f'<tr class="why" role="row"><td role="cell" colspan="{len(shown) + 1}">{why}</td></tr></tbody>'
    )


def value_cell(item: Measurement | None) -> str:
    """Return a number, with its interval and count in small print below."""
    if item is None:
        return '<span class="none">–</span>'
    if not item.known:
        reason = f'<span class="aside">{safe(item.note)}</span>' if item.note else ""
        return f'<span class="none">{safe(quantity(item))}</span>{reason}'
    brackets = aside(item)
    return (
        f"<span>{safe(quantity(item))}</span>{_small(f'({brackets})')}"
        if brackets
        else f"<span>{safe(quantity(item))}</span>"
    )


def _small(text: str) -> str:
    """Return small print that breaks only behind a comma."""
    parts = (f"<b>{safe(part)}</b>" for part in text.split(", "))
    return f'<span class="aside">{", ".join(parts)}</span>'


def capital(text: str) -> str:
    """Return text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


def breakable(name: str) -> str:
    """Return a name that may break behind an underscore, a hyphen, a dot or a slash."""
    return re.sub(r"([_\-./])", r"\1<wbr>", safe(name))


def bar(item: Measurement, top: float, css: str = "", mark: float | None = None) -> str:
    """Return a bar from zero to the value with its interval and, when given, the limit."""
    if not math.isfinite(item.value) or top <= 0 or item.value < 0:
        return ""
    parts = [f'<i style="width:{_percent(item.value, top)}"></i>']
    if item.low is not None and item.high is not None:
        wide = _percent(item.high - item.low, top)
        parts.append(f'<u style="left:{_percent(item.low, top)};width:{wide}"></u>')
    if mark is not None:
        parts.append(f'<s style="left:{_percent(mark, top)}"></s>')
    return f'<span class="bar {css}" aria-hidden="true">{"".join(parts)}</span>'


def _percent(value: float, top: float) -> str:
    return f"{min(100.0, max(0.0, 100 * value / top)):.1f}%"


def errors(report: Report) -> str:
    """Return one table of action errors for each thing that the actions were compared with."""
    parts = []
    for group, members in error_groups(report).items():
        rows = [row for row in report.rows if any(row.get(name) for name in members)]
        tints = dict(zip((row.name for row in report.rows), series(report.rows), strict=True))
        heads = "".join(
            f'<th scope="col" class="n"><span class="key {tints[row.name]}"></span>{breakable(row.name)}</th>'
            for row in rows
        )
        lines = "".join(_error_line(name, rows, tints) for name in members)
        first = next(item for row in rows for name in members if (item := row.get(name)))
        note = f"{first.note}; " if first.note else ""
        body = (
            f'<div class="scroll"><table class="small"><thead><tr><th scope="col">Dimension</th>{heads}</tr></thead>'
            f"<tbody>{lines}</tbody></table></div>"
        )
        sub = f"{note}bars compare the variants within a dimension."
        parts.append(section(f"Action {label(group)} by dimension", body, capital(sub), "measured"))
    return "".join(parts)


def _error_line(name: str, rows: Iterable[Row], tints: dict[str, str]) -> str:
    items = [(row, row.get(name)) for row in rows]
    top = max((_reach(item) for _, item in items), default=0.0)
    cells = "".join(
        f'<td class="n">{value_cell(item)}{bar(item, top, tints[row.name]) if item else ""}</td>' for row, item in items
    )
    return f'<tr><th scope="row">{safe(dimension(name))}</th>{cells}</tr>'


def others(report: Report) -> str:
    """Return the measured numbers that stand nowhere else, and why some could not be had."""
    shown = other_names(report)
    missing = unmeasured(report, percentile_names(report))
    body = numbers(report, shown, "measured", None) if shown else ""
    if remarks := notes(report, "measured", lambda item: item.known):
        body += "<h3>Methods</h3>" + _notes([f"{', '.join(labels)}: {note}" for note, labels in remarks.items()])
    if missing:
        body += f"<h3>Unmeasured</h3>{_notes(missing)}"
    return section("Further measurements and methods", body, measured_where(report) + ".", "measured") if body else ""


def numbers(report: Report, shown: Sequence[str], origin: str, where: str | None) -> str:
    """Return a table of one kind of numbers from one place: a number a row, a variant a column."""
    columns, cells = matrix(report, shown, origin, where)
    heads = "".join(f'<th scope="col" class="n">{breakable(name)}</th>' for name in columns)
    lines = "".join(
        f'<tr><th scope="row">{safe(label(name))}</th>'
        + "".join(f'<td class="n">{value_cell(item)}</td>' for item in items)
        + "</tr>"
        for name, items in zip(shown, cells, strict=True)
    )
    return (
        f'<div class="scroll"><table><thead><tr><th scope="col">Measurement</th>{heads}</tr>'
        f"</thead><tbody>{lines}</tbody></table></div>"
    )


def _notes(lines: Iterable[str]) -> str:
    return '<ul class="notes">' + "".join(f"<li>{safe(line)}</li>" for line in lines) + "</ul>"


def predicted(report: Report) -> str:
    """Return a block for each profile that numbers were predicted for."""
    parts = []
    for where in places(report, "predicted"):
        body = numbers(report, names(report, "predicted", where), "predicted", where)
        remarks = notes(report, "predicted", where=where)
        body += _notes([f"{', '.join(labels)}: {note}" for note, labels in remarks.items()])
        sub = f"Computed by a model, not measured. {brackets(report, 'predicted', where)}"
        parts.append(section(f"Predicted for {plain(where)}", body, sub, "predicted", "guess"))
    return "".join(parts)


def tables(found: Sequence[Table]) -> str:
    """Return the details tables."""
    return section("Details", "".join(_details(table) for table in found)) if found else ""


def _details(table: Table) -> str:
    heads = "".join(
        f'<th scope="col"{_right(n)}>{safe(name)}</th>' for name, n in zip(table.columns, table.numeric, strict=True)
    )
    lines = []
    same = ' class="same"'
    for row in table.rows[:MOST_RECORDS]:
        cells = [f"<td{_right(n)}>{safe(text)}</td>" for text, n in zip(row, table.numeric, strict=True)]
        lines.append(f"<tr{'' if row[0] else same}>{''.join(cells)}</tr>")
    more = len(table.rows) - MOST_RECORDS
    rest = f'<p class="sub">{more} more rows in report.json.</p>' if more > 0 else ""
    return (
        f'<h3>{safe(table.title)}</h3><div class="scroll"><table class="groups"><thead><tr>{heads}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>{rest}"
    )


def _right(numeric: bool) -> str:
    return ' class="n"' if numeric else ""


def circumstances(report: Report) -> str:
    """Return environment, warnings and the command."""
    parts = []
    if found := facts(report.environment):
        pairs = "".join(f"<div><dt>{safe(name)}</dt><dd>{safe(text)}</dd></div>" for name, text in found)
        parts.append(section("Environment", f'<dl class="pairs">{pairs}</dl>'))
    if report.warnings:
        items = "".join(f"<li>{safe(text)}</li>" for text in report.warnings)
        parts.append(section("Warnings", f'<ul class="warn">{items}</ul>', ident="warnings"))
    command = f"<pre>{safe(report.command)}</pre>" if report.command else ""
    raw = "Every raw sample and unrounded number is in <code>report.json</code> beside this file."
    parts.append(section("Reproduce", f'{command}<p class="sub" style="margin-top:10px">{raw}</p>'))
    return "".join(parts)
