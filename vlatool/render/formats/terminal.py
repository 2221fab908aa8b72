"""The report on a terminal: the result in the first line, nothing wider than the screen."""

from __future__ import annotations

import io
import re

from rich.console import Console
from rich.text import Text as Words

from vlatool.render._format import plain
from vlatool.render.document import Block, Code, Document, Line, Notes, Pairs, Section, Table, Text, build
from vlatool.render.formats._layout import SHARED_ROLE, grid, layout
from vlatool.report import Report

STYLES = {"pass": "bold green", "fail": "bold red", "inconclusive": "bold yellow", "info": "bold cyan"}
TRUST = {"": "", "valid": "green", "suspect": "bold yellow", "invalid": "bold red", "note": ""}
MOST_LINES = 24
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
        self._stream = io.StringIO()
        self._console = Console(
            file=self._stream,
            width=self.width,
            force_terminal=color,
            no_color=not color,
            color_system="standard" if color else None,
            legacy_windows=False,
            _environ={},
        )

    def render(self, report: Report) -> str:
        """Return the text, with a line break at the end."""
        document = build(report)
        lines, before = self._head(document), ""
        for section in document.as_text:
            if section.brief or not self.brief:
                lines += self._section(section, before)
                before = section.where
        self._stream.seek(0)
        self._stream.truncate()
        for line in lines:
            self._console.print(line, soft_wrap=True)
        return self._stream.getvalue()

    def _head(self, document: Document) -> list[Words]:
        report = document.report
        verdict = report.verdict.upper()
        indent = " " * (len(verdict) + 2)
        lines = self._wrapped(document.result, f"{verdict}  ", indent) or [Words(verdict)]
        lines[0].stylize(STYLES[report.verdict], 0, len(verdict))
        for sentence in document.sentences:
            lines += self._wrapped(sentence, indent)
        lines += self._wrapped(document.trust, indent, style=TRUST[report.validity])
        for effect, reason, remedy in document.reasons:
            lines += self._wrapped(f"{effect}: {reason}", f"{indent}- ", f"{indent}  ", TRUST[effect])
            lines += self._wrapped(remedy, f"{indent}  ")
        title = " · ".join(part for part in (report.title if report.summary else "", report.created) if part)
        lines += self._wrapped(title, indent, style="dim")
        limits = ", ".join(" ".join(pair) for pair in document.limits)
        return lines + (self._wrapped(limits, "Asked for: ", "  ") if limits else [])

    def _section(self, section: Section, before: str) -> list[Words]:
        """Return a section; where its numbers are from stands in the heading, in short when it is as before."""
        heading = ": ".join(part for part in (section.title, section.where[:1].lower() + section.where[1:]) if part)
        if section.origin and section.where == before and section.origin not in section.title.lower():
            heading = f"{section.title} ({section.origin})"
        elif section.origin:
            heading = re.sub(section.origin, section.origin.upper(), heading, count=1, flags=re.IGNORECASE)
        lines = [Words(), *self._wrapped(heading, style=HEADING)]
        for index, block in enumerate(section.blocks):
            lines += [Words()] if index and not getattr(block, "title", "") else []
            lines += self._block(block)
        return [*lines, *self._wrapped(section.about, style="dim")]

    def _block(self, block: Block) -> list[Words]:
        match block:
            case Table():
                return [*self._title(block.title), *self._table(block)]
            case Notes(warning=True):
                return [line for text in block.lines for line in self._wrapped(text, "! ", "  ", "yellow")]
            case Notes(title=""):
                return [line for text in block.lines for line in self._wrapped(text, "", "  ", "dim")]
            case Notes():
                lines = [line for text in block.lines for line in self._wrapped(text, "  ", "    ")]
                return [*self._title(block.title), *lines]
            case Pairs():
                return self._wrapped(" · ".join(f"{name} {text}" for name, text in block.pairs))
            case Code() | Text():
                return self._wrapped(block.text, "", "  ")
        return []

    def _title(self, title: str) -> list[Words]:
        return [Words(), *self._wrapped(title, style=HEADING)] if title else []

    def _table(self, table: Table) -> list[Words]:
        lines = [Words(text, _style(line)) for line, text in grid(layout(table, MOST_LINES), self.width)]
        if table.beside and len(table.columns) > 2:
            lines += self._wrapped(f"Beside each number: {table.beside}.", style="dim")
        if len(table.lines) > MOST_LINES:
            lines.append(Words(f"… {len(table.lines) - MOST_LINES} more rows in report.json", "dim"))
        remarks = [(line.remark, "green" if line.best else "") for line in table.lines if line.remark]
        lines += [Words()] if remarks else []
        for remark, style in remarks:
            lines += self._wrapped(remark, "", "  ", style)
        return lines

    def _wrapped(self, text: str, first: str = "", indent: str | None = None, style: str = "") -> list[Words]:
        """Return lines that fit: the first begins with ``first``, the others with ``indent``."""
        indent = first if indent is None else indent
        text = plain(text)
        if not text.strip():
            return []
        head = Words(first + text).wrap(self._console, self.width)[0]
        rest = Words((first + text)[len(head.plain) :].lstrip())
        lines = list(rest.wrap(self._console, self.width - len(indent))) if rest.plain else []
        return [Words(line.rstrip(), style) for line in (head.plain, *(indent + line.plain for line in lines))]


def _style(line: Line | None) -> str:
    if line is None:
        return ""
    return "dim" if line.role == SHARED_ROLE else "bold green" if line.best else ""
