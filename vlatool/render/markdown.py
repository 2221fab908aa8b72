"""The report as GitHub-flavoured Markdown, for a comment on a pull request."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from vlatool.render._boards import HEADS, KIND, by_state, cells, costs, reasons
from vlatool.render._columns import about, board, columns
from vlatool.render._format import full, label, limit, plain
from vlatool.render._percentiles import percentiles
from vlatool.render._tables import details
from vlatool.render._trust import MARKS as TRUST
from vlatool.render._trust import findings, reason, remedy, sentence
from vlatool.render._view import (
    brackets,
    error_groups,
    facts,
    matrix,
    measured_where,
    names,
    notes,
    other_names,
    place,
    places,
    role,
    unmeasured,
)
from vlatool.report import Report

MARKS = {"pass": "✅", "fail": "❌", "inconclusive": "❔", "info": "ℹ️"}
MOST_RECORDS = 60


class MarkdownRenderer:
    """Writes tables that a pull request shows: the verdict and the variants first, the rest folded."""

    def render(self, report: Report) -> str:
        """Return the Markdown text."""
        if report.kind == KIND:
            return "\n\n".join([*_head(report), *_boards(report), *_circumstances(report)]) + "\n"
        blocks = [
            *_head(report),
            *(_predicted(report) if board(report) else []),
            *_variants(report),
            *_percentiles(report),
            *([] if board(report) else _predicted(report)),
            *_further(report),
            *_details(report),
            *_circumstances(report),
        ]
        return "\n\n".join(blocks) + "\n"


def _boards(report: Report) -> list[str]:
    blocks = []
    for heading, rows in by_state(report):
        blocks.append(f"**{inline(heading)}** (predicted, not measured)")
        if any(row.get("latency_p50", "predicted") for row in rows):
            numeric = [False, False, False, *[True] * (len(HEADS) - 3)]
            blocks.append(_table(HEADS, [cells(row) for row in rows], numeric))
        blocks.append("\n".join(f"- {inline(told)}" for told in reasons(rows)))
    titles, body = costs(report)
    return blocks + ([f"**Power and cost** (predicted)\n\n{_table(titles, body)}"] if body else [])


def inline(text: object) -> str:
    """Return text that Markdown and HTML take literally, also inside a table."""
    safe = plain(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*_\[\]|~$])", r"\\\1", safe)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], numeric: Sequence[bool] | None = None) -> str:
    right = list(numeric) if numeric is not None else [False] + [True] * (len(heads) - 1)
    lines = [heads, ["---:" if n else ":---" for n in right]]
    lines += [[inline(cell) for cell in row] for row in rows]
    lines[0] = [inline(head) for head in heads]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _fold(title: str, body: Sequence[str]) -> list[str]:
    return [f"<details><summary>{inline(title)}</summary>", *body, "</details>"]


def _list(lines: Iterable[str]) -> list[str]:
    text = "\n".join(f"- {inline(line)}" for line in lines)
    return [text] if text else []


def _head(report: Report) -> list[str]:
    first, *more = report.summary or (report.title,)
    blocks = [f"### {MARKS[report.verdict]} {report.verdict.upper()}: {inline(first)}"]
    if report.summary:
        blocks.append(f"**{inline(report.title)}**" + (f" · {inline(report.created)}" if report.created else ""))
    if more:
        blocks.append(" ".join(inline(sentence) for sentence in more))
    blocks += _trust(report)
    if report.limits:
        asked = ", ".join(" ".join(limit(name, wanted)) for name, wanted in report.limits.items())
        blocks.append(f"Asked for: {inline(asked)}")
    return blocks


def _trust(report: Report) -> list[str]:
    """Return whether the measurement can be trusted, and each reason with its remedy."""
    told = [f"**{TRUST[report.validity]} {inline(sentence(report))}**"] if report.validity else []
    lines = [
        f"- *{found.effect}*: " + " ".join(inline(part) for part in (reason(found), remedy(found)) if part)
        for found in findings(report)
    ]
    return told + (["\n".join(lines)] if lines else [])


def _percentiles(report: Report) -> list[str]:
    found = percentiles(report)
    if found is None:
        return []
    heads, body = ["latency, ms"], [[name] for name in found.names]
    for column, variant in enumerate(found.variants):
        heads += [variant, found.bound] if found.bounded else [variant]
        for line, values, bounds in zip(body, found.values, found.bounds, strict=True):
            line += [values[column], bounds[column] or "–"] if found.bounded else [values[column]]
    return [_table(heads, body), *([found.about()] if found.about() else [])]


def _variants(report: Report) -> list[str]:
    if not report.rows:
        return ["The report has no rows."]
    shown = columns(report)
    several = len(places(report, "measured")) > 1
    rows = []
    for row in report.rows:
        items = [column.of(row) for column in shown]
        where = [next((place(report, item.where) for item in items if item), "–")] if several else []
        rows.append([row.name, role(row), *where, *(full(item) if item else "–" for item in items)])
    heads = ["variant", "role", *(["where"] if several else []), *(column.title for column in shown)]
    numeric = [False] * (3 if several else 2) + [True] * len(shown)
    reasons = [f"{row.name}: {row.reason}" for row in report.rows if row.reason]
    words = " ".join(part for part in (about(report), brackets(report, "measured")) if part)
    top = f"**{inline(measured_where(report))}.** {inline(words)}".rstrip()
    return [top, _table(heads, rows, numeric), *_list(reasons)]


def _matrix(report: Report, shown: Sequence[str], origin: str, where: str | None = None) -> str:
    columns, cells = matrix(report, shown, origin, where)
    rows = ([label(name), *(full(item) if item else "–" for item in items)]
            for name, items in zip(shown, cells, strict=True))  # fmt: skip
    return _table(["measurement", *columns], rows)


def _predicted(report: Report) -> list[str]:
    blocks = []
    for where in places(report, "predicted"):
        ranges = inline(brackets(report, "predicted", where))
        blocks.append(f"**Predicted for {inline(where)}** (computed by a model, not measured). {ranges}".rstrip())
        blocks.append(_matrix(report, names(report, "predicted", where), "predicted", where))
        blocks += _list(f"{', '.join(of)}: {note}" for note, of in notes(report, "predicted", where=where).items())
    return blocks


def _further(report: Report) -> list[str]:
    shown = [*(name for group in error_groups(report).values() for name in group), *other_names(report)]
    body = [_matrix(report, shown, "measured")] if shown else []
    remarks = notes(report, "measured", lambda item: item.known)
    body += _list(f"{', '.join(labels)}: {note}" for note, labels in remarks.items())
    if missing := unmeasured(report):
        body += ["Unmeasured:", *_list(missing)]
    return _fold(f"Further numbers and methods. {measured_where(report)}", body) if body else []


def _details(report: Report) -> list[str]:
    blocks: list[str] = []
    for table in details(report):
        body = [_table(table.columns, table.rows[:MOST_RECORDS], table.numeric)]
        if len(table.rows) > MOST_RECORDS:
            body.append(f"{len(table.rows) - MOST_RECORDS} more rows in report.json.")
        blocks += _fold(table.title, body)
    return blocks


def _circumstances(report: Report) -> list[str]:
    blocks = ["**Warnings**", *_list(report.warnings)] if report.warnings else []
    if found := facts(report.environment):
        blocks += _fold("Environment", [_table(["fact", "value"], found, [False, False])])
    if report.command:
        command = plain(report.command)
        fence = "`" * (max([2, *(len(run) for run in re.findall(r"`+", command))]) + 1)
        blocks.append(f"{fence}\n{command}\n{fence}")
    return blocks
