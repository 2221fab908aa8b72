"""The report as GitHub-flavoured Markdown, for a comment on a pull request."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from vlatool.render._format import plain
from vlatool.render.document import Block, Cell, Code, Document, Notes, Pairs, Section, Table, Text, build
from vlatool.report import Report

MARKS = {"pass": "✅", "fail": "❌", "inconclusive": "❔", "info": "ℹ️"}
TRUST = {"valid": "✅", "suspect": "⚠️", "invalid": "⛔"}
MOST_LINES = 60


class MarkdownRenderer:
    """Writes tables that a pull request shows: the verdict and the variants first, the rest folded."""

    def render(self, report: Report) -> str:
        """Return the Markdown text."""
        document = build(report)
        blocks = _head(document)
        for section in document.as_text:
            blocks += _folded(section) if section.folded else [_heading(section), *_blocks(section.blocks)]
        return "\n\n".join(blocks) + "\n"


def inline(text: object) -> str:
    """Return text that Markdown and HTML take literally, also inside a table."""
    safe = plain(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*_\[\]|~$])", r"\\\1", safe)


def _head(document: Document) -> list[str]:
    report = document.report
    blocks = [f"### {MARKS[report.verdict]} {report.verdict.upper()}: {inline(document.result)}"]
    if report.summary:
        blocks.append(f"**{inline(report.title)}**" + (f" · {inline(report.created)}" if report.created else ""))
    if document.sentences:
        blocks.append(" ".join(inline(sentence) for sentence in document.sentences))
    if document.trust:
        blocks.append(f"**{TRUST[report.validity]} {inline(document.trust)}**")
    reasons = (f"- *{effect}*: {inline(f'{reason} {remedy}'.rstrip())}" for effect, reason, remedy in document.reasons)
    blocks += ["\n".join(reasons)] if document.reasons else []
    if document.limits:
        blocks.append(f"Asked for: {inline(', '.join(' '.join(pair) for pair in document.limits))}")
    return blocks


def _heading(section: Section) -> str:
    where = f" ({inline(section.where[:1].lower() + section.where[1:])})" if section.where else ""
    return f"**{inline(section.title)}**{where}{'.' if section.about else ''} {inline(section.about)}".rstrip()


def _folded(section: Section) -> list[str]:
    """Return the section folded; each table with a title of its own, too, is folded under that."""
    under: dict[str, list[str]] = {}
    for block in section.blocks:
        title = block.title if isinstance(block, Table) and block.title else ""
        under.setdefault(title, []).extend(_block(block))
    blocks = []
    for title, body in under.items():
        whole = f"{section.title}. {section.where}".rstrip(" .")
        about = [inline(section.about)] if section.about and not title else []
        blocks += [f"<details><summary>{inline(title or whole)}</summary>", *about, *body, "</details>"]
    return blocks


def _blocks(blocks: Iterable[Block]) -> list[str]:
    return [text for block in blocks for text in _block(block)]


def _block(block: Block) -> list[str]:
    match block:
        case Table():
            return _table(block)
        case Notes():
            return [*([f"{inline(block.title)}:"] if block.title else []), _list(block.lines)]
        case Pairs():
            return [_grid(["fact", "value"], [list(map(inline, pair)) for pair in block.pairs], [False, False])]
        case Code():
            fence = "`" * (max([2, *map(len, re.findall(r"`+", block.text))]) + 1)
            return [f"{fence}\n{block.text}\n{fence}"]
        case Text():
            return [inline(block.text)]
    return []


def _table(table: Table) -> list[str]:
    kept = table.filled_columns()
    heads, numeric = [], []
    for index in kept:
        heads.append(table.columns[index].title)
        numeric.append(table.columns[index].numeric)
        if table.beside and index:
            heads.append(table.beside)
            numeric.append(True)
    lines = []
    for line in table.lines[:MOST_LINES]:
        cells = [text for index in kept for text in _cell(line.cells[index], table.beside if index else "")]
        lines.append([f"**{inline(cells[0])}**" if line.best else inline(cells[0]), *map(inline, cells[1:])])
    blocks = [_grid(heads, lines, numeric)]
    if len(table.lines) > MOST_LINES:
        blocks.append(f"{len(table.lines) - MOST_LINES} more rows in report.json.")
    remarks = [line.remark for line in table.lines if line.remark]
    return [*blocks, _list(remarks)] if remarks else blocks


def _cell(cell: Cell, beside: str) -> list[str]:
    """Return the text of a cell, with what qualifies it in brackets, or in a cell of its own."""
    if beside:
        return [cell.text, cell.interval.removeprefix("≤ ") or "–"]
    text = f"{cell.text} ({', '.join(cell.brackets)})" if cell.brackets else cell.text
    return [f"{text}{', ' if cell.known else ': '}{cell.note}" if cell.note else text]


def _grid(heads: Sequence[str], lines: Iterable[Sequence[str]], numeric: Sequence[bool]) -> str:
    rules = ["---:" if right else ":---" for right in numeric]
    return "\n".join(f"| {' | '.join(line)} |" for line in ([inline(head) for head in heads], rules, *lines))


def _list(lines: Iterable[str]) -> str:
    return "\n".join(f"- {inline(line)}" for line in lines)
