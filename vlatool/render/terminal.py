"""The report on a terminal: the result in the first line, nothing wider than the screen."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence

from rich.console import Console
from rich.text import Text

from vlatool.render._boards import HEADS as BOARD_HEADS
from vlatool.render._boards import KIND, by_state, cells, costs, reasons
from vlatool.render._columns import Column, about, board, columns
from vlatool.render._format import aside, count, label, limit, plain, quantity, span
from vlatool.render._grid import grid
from vlatool.render._percentiles import percentiles
from vlatool.render._samples import finite, sparkline
from vlatool.render._tables import details
from vlatool.render._trust import findings, reason, remedy, sentence
from vlatool.render._view import (
    brackets,
    error_groups,
    facts,
    in_order,
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
from vlatool.report import Report, Row

STYLES = {"pass": "bold green", "fail": "bold red", "inconclusive": "bold yellow", "info": "bold cyan"}
TRUST = {"": "", "valid": "green", "suspect": "bold yellow", "invalid": "bold red", "note": ""}
MOST_RECORDS = 24
HEADING = "bold"


class TerminalRenderer:
    """Writes text for a terminal.

    Args:
        width: Columns that no line exceeds, at least 40.
        color: Whether to write ANSI colours.
        brief: Leave out what the HTML page shows better: further measurements, details, environment and command.
    """

    def __init__(self, width: int = 80, color: bool = False, brief: bool = False) -> None:
        self.brief = brief
        self.width = max(40, width)
        self.color = color
        self._stream = io.StringIO()
        self._console = self._open()

    def _open(self) -> Console:
        return Console(
            file=self._stream,
            width=self.width,
            force_terminal=self.color,
            no_color=not self.color,
            color_system="standard" if self.color else None,
            legacy_windows=False,
            _environ={},
        )

    def render(self, report: Report) -> str:
        """Return the text, with a line break at the end."""
        if report.kind == KIND:
            return self._printed([*self._verdict(report), *self._boards(report), *self._warnings(report)])
        first, last = ([], self._predicted(report)) if not board(report) else (self._predicted(report), [])
        lines = [
            *self._verdict(report),
            *first,
            *self._variants(report),
            *([] if self.brief else [*self._further(report), *self._details(report)]),
            *last,
            *([] if self.brief else self._environment(report)),
            *self._warnings(report),
            *([] if self.brief else self._command(report)),
        ]
        return self._printed(lines)

    def _boards(self, report: Report) -> list[Text]:
        lines = []
        for heading, rows in by_state(report):
            lines += self._heading(f"{heading} (predicted, not measured)")
            if any(row.get("latency_p50", "predicted") for row in rows):
                styles = {place: "bold green" for place, row in enumerate(rows) if row.role == "chosen"}
                numeric = [False, False, False, *[True] * (len(BOARD_HEADS) - 3)]
                lines += self._table(BOARD_HEADS, [cells(row) for row in rows], styles=styles, numeric=numeric)
            lines += [line for told in reasons(rows) for line in self._wrapped(told, indent="  ")]
        titles, body = costs(report)
        return lines + ([*self._heading("Power and cost (predicted)"), *self._table(titles, body)] if body else [])

    def _printed(self, lines: Iterable[Text]) -> str:
        self._stream.seek(0)
        self._stream.truncate()
        for line in lines:
            self._console.print(line, soft_wrap=True)
        return self._stream.getvalue()

    def _verdict(self, report: Report) -> list[Text]:
        verdict = report.verdict.upper()
        first, *more = report.summary or (report.title,)
        indent = " " * (len(verdict) + 2)
        lines = self._wrapped(first, f"{verdict}  ", indent)
        lines = lines or [Text(verdict)]
        lines[0].stylize(STYLES[report.verdict], 0, len(verdict))
        for each in more:
            lines += self._wrapped(each, indent)
        lines += self._trust(report, indent)
        about = " · ".join(part for part in (report.title if report.summary else "", report.created) if part)
        lines += self._wrapped(about, indent, style="dim")
        asked = ", ".join(" ".join(limit(name, wanted)) for name, wanted in report.limits.items())
        return lines + (self._wrapped(asked, "Asked for: ", "  ") if asked else [])

    def _trust(self, report: Report, indent: str) -> list[Text]:
        """Return whether the measurement can be trusted, each reason, and its remedy below."""
        lines = self._wrapped(sentence(report), indent, style=TRUST[report.validity])
        for found in findings(report):
            lines += self._wrapped(
                f"{found.effect}: {reason(found)}", f"{indent}- ", f"{indent}  ", TRUST[found.effect]
            )
            lines += self._wrapped(remedy(found), f"{indent}  ")
        return lines

    def _variants(self, report: Report) -> list[Text]:
        if not report.rows:
            return self._heading("The report has no rows")
        if self._alone(report):
            reasons = self._reasons(report)
            return [*self._percentiles(report, self._origin(report)), *self._numbers(report),
                    *([Text(), *reasons] if reasons else []), *self._spread(report)]  # fmt: skip
        shown = columns(report)
        if not shown and len(report.rows) == 1:
            reasons = self._reasons(report)
            return [*([Text(), *reasons] if reasons else []), *self._spread(report)]
        same = [self._same_count(report, column) for column in shown]
        body = [["", *same]] if any(same) else []
        styles: dict[int, str] = {0: "dim"} if body else {}
        for row in report.rows:
            styles[len(body)] = "bold green" if row.role == "chosen" else ""
            body += self._variant(row, shown, same, report)
        lines = self._heading(self._origin(report))
        lines += self._table(["variant", *(column.title for column in shown)], body, styles=styles)
        lines += self._wrapped(about(report), style="dim")
        lines += self._wrapped(brackets(report, "measured"), style="dim")
        return [*lines, Text(), *self._reasons(report), *self._spread(report)]

    def _alone(self, report: Report) -> bool:
        """Return whether there is one variant, so that one list holds all of its numbers."""
        return len(report.rows) == 1 and bool(percentile_names(report))

    def _percentiles(self, report: Report, heading: str) -> list[Text]:
        found = percentiles(report)
        if found is None:
            return []
        title, several = "latency, ms", len(found.variants) > 1
        if several:
            heads = [title, *found.variants]
            body = [[name, *cells] for name, cells in zip(found.names, found.beside(), strict=True)]
        else:
            heads = [title, "value", *([found.bound] if found.bounded else [])]
            bounds = ([f"≤ {line[0]}" if line[0] and "most" in found.bound else line[0]] for line in found.bounds)
            body = [[name, line[0], *(bound if found.bounded else [])]
                    for name, line, bound in zip(found.names, found.values, bounds, strict=True)]  # fmt: skip
        meaning = f"≤: {found.bound}. " if several and found.bounded else ""
        return [
            *self._heading(heading),
            *self._table(heads, body),
            *self._wrapped(f"{meaning}{found.about()}", style="dim"),
        ]

    def _numbers(self, report: Report) -> list[Text]:
        """Return the other numbers of the one variant: a number a line, its interval and its count beside it."""
        (row,) = report.rows
        shown = in_order(name for name in names(report) if name not in percentile_names(report))
        items = [item for name in shown if (item := row.get(name)) and item.known]
        body = [[label(item.name), quantity(item), span(item), count(item.samples)] for item in items]
        kept = [place for place in range(4) if place < 2 or any(line[place] for line in body)]
        heads = [("measured", "value", "interval", "")[place] for place in kept]
        return [Text(), *self._table(heads, [[line[place] for place in kept] for line in body])] if body else []

    def _origin(self, report: Report) -> str:
        return measured_where(report).replace("Measured", "MEASURED", 1)

    def _same_count(self, report: Report, column: Column) -> str:
        items = [column.of(row) for row in report.rows]
        found = {count(item.samples) for item in items if item is not None and item.known}
        return found.pop() if len(found) == 1 else ""

    def _variant(self, row: Row, shown: Sequence[Column], same: Sequence[str], report: Report) -> list[list[str]]:
        items = [column.of(row) for column in shown]
        lines = [
            [plain(row.name), *(quantity(item) if item else "–" for item in items)],
            ["", *(span(item) if item else "" for item in items)],
            ["", *(count(item.samples) if item and not once else "" for item, once in zip(items, same, strict=True))],
        ]
        if len(places(report, "measured")) > 1 and (where := next((item.where for item in items if item), "")):
            lines[1][0] = f"  on {place(report, where)}"
        return lines

    def _reasons(self, report: Report) -> list[Text]:
        lines = []
        for row in report.rows:
            if row.role == "subject" and not row.reason:
                continue
            because = f": {row.reason}" if row.reason else ""
            style = "green" if row.role == "chosen" else ""
            lines += self._wrapped(f"{row.name}, {role(row)}{because}", "", "  ", style)
        return lines

    def _spread(self, report: Report) -> list[Text]:
        body = []
        known = any((tail := row.get("latency_p99")) and tail.known for row in report.rows)
        tails = known and not percentile_names(report)
        for row in report.rows:
            samples = finite(row.raw.get("latency_ms") or [])
            if len(samples) > 1:
                tail = row.get("latency_p99") if tails else None
                beside = f"{quantity(tail)} ({aside(tail)})" if tail and aside(tail) else quantity(tail) if tail else ""
                body.append([plain(row.name), sparkline(samples, 20), beside or count(len(samples))])
        where = ", this host" if board(report) else ""
        heads = [f"spread of latency{where}", "min … p99", "latency p99" if tails else "calls"]
        return [Text(), *self._table(heads, body, [False, False, True])] if body else []

    def _further(self, report: Report) -> list[Text]:
        dimensions = [name for group in error_groups(report).values() for name in group]
        shown = [
            *dimensions,
            *(name for name in other_names(report) if name != "latency_p99" or not self._spread(report)),
        ]
        lines: list[Text] = []
        if not self._alone(report):
            lines += self._percentiles(report, "Percentiles of the latency")
        if shown and not self._alone(report):
            lines += [
                *self._heading(f"Further, {self._origin(report)}"),
                *self._matrix(report, shown, "measured", None),
            ]
        lines += self._notes(notes(report, "measured", lambda item: item.known))
        missing = unmeasured(report)
        lines += self._heading("Unmeasured") if missing else []
        for each in missing:
            lines += self._wrapped(each, "  ", "    ")
        return lines

    def _notes(self, found: Mapping[str, Iterable[str]]) -> list[Text]:
        lines: list[Text] = []
        for note, labels in found.items():
            lines += self._wrapped(f"{', '.join(labels)}: {note}", "", "  ", "dim")
        return [Text(), *lines] if lines else []

    def _matrix(self, report: Report, shown: Sequence[str], origin: str, where: str | None) -> list[Text]:
        columns, cells = matrix(report, shown, origin, where)
        body = []
        for name, items in zip(shown, cells, strict=True):
            body.append([label(name), *(quantity(item) if item else "–" for item in items)])
            counts = [count(item.samples) if item and item.known else "" for item in items]
            same = len({text for text in counts if text}) == 1
            body.append([f"  {max(counts)}" if same else "", *(span(item) if item else "" for item in items)])
            body.append(["", *([""] * len(items) if same else counts)])
        return self._table(["", *(plain(name) for name in columns)], body)

    def _details(self, report: Report) -> list[Text]:
        lines: list[Text] = []
        for table in details(report):
            lines += self._heading(table.title)
            lines += self._table(table.columns, table.rows[:MOST_RECORDS], table.numeric)
            if len(table.rows) > MOST_RECORDS:
                lines.append(Text(f"… {len(table.rows) - MOST_RECORDS} more rows in report.json", "dim"))
        return lines

    def _predicted(self, report: Report) -> list[Text]:
        lines: list[Text] = []
        for where in places(report, "predicted"):
            lines += self._heading(f"PREDICTED for {plain(where)}: computed by a model, not measured")
            lines += self._matrix(report, names(report, "predicted", where), "predicted", where)
            lines += self._wrapped(brackets(report, "predicted", where), style="dim")
            lines += self._notes(notes(report, "predicted", where=where))
        return lines

    def _environment(self, report: Report) -> list[Text]:
        found = facts(report.environment)
        told = " · ".join(f"{name} {text}" for name, text in found)
        return [*self._heading("Environment"), *self._wrapped(told)] if found else []

    def _warnings(self, report: Report) -> list[Text]:
        lines = self._heading("Warnings") if report.warnings else []
        for text in report.warnings:
            lines += self._wrapped(text, "! ", "  ", "yellow")
        return lines

    def _command(self, report: Report) -> list[Text]:
        return [*self._heading("Command"), *self._wrapped(report.command, "", "  ")] if report.command else []

    def _heading(self, text: str) -> list[Text]:
        return [Text(), *self._wrapped(text, style=HEADING)]

    def _wrapped(self, text: str, first: str = "", indent: str | None = None, style: str = "") -> list[Text]:
        """Return lines that fit: the first begins with ``first``, the others with ``indent``."""
        indent = first if indent is None else indent
        text = plain(text)
        if not text.strip():
            return []
        head = Text(first + text).wrap(self._console, self.width)[0]
        rest = Text((first + text)[len(head.plain) :].lstrip())
        lines = list(rest.wrap(self._console, self.width - len(indent))) if rest.plain else []
        return [Text(line.rstrip(), style) for line in (head.plain, *(indent + line.plain for line in lines))]

    def _table(
        self,
        heads: Sequence[str],
        body: Sequence[Sequence[str]],
        numeric: Sequence[bool] | None = None,
        styles: Mapping[int, str] | None = None,
    ) -> list[Text]:
        marked = styles or {}
        return [Text(line, marked.get(row, "")) for row, line in grid(heads, body, self.width, numeric)]
