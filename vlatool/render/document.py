"""A report as a document: a head, then sections of blocks. Built once; a format draws the kinds of blocks, and no more.

A section is one file in ``vlatool/render/sections/`` with one public class, or what another package names in the
entry point group ``vlatool.sections``: ``build(report)`` returns the sections that the report has something for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Protocol

from vlatool import registry
from vlatool.errors import PluginError
from vlatool.render import _trust
from vlatool.render._columns import Sides, sides
from vlatool.render._format import limit
from vlatool.render._view import measured_where
from vlatool.render.charts.svg import Canvas
from vlatool.report import Report

ABSENT = "–"


@dataclass(frozen=True)
class Bar:
    """A bar below a number, or in a column of its own.

    Args:
        value: Share of the width, 0-1.
        css: Class of the colour.
        low, high: Interval, as shares.
        limit: Where the limit is, as a share.
    """

    value: float
    css: str = ""
    low: float | None = None
    high: float | None = None
    limit: float | None = None


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Args:
        text: The number with its unit, or any text.
        interval, count: What qualifies the number, each with its sign: ``97.4–99.0``, ``n = 1000``.
        note: Why there is no number, or where it is from.
        known: False where a number is missing.
        tail: A further number that a page alone has room for.
        bar: Drawn on a page.
        css: Class of the colour of the variant that the cell names.
    """

    text: str = ""
    interval: str = ""
    count: str = ""
    note: str = ""
    known: bool = True
    tail: str = ""
    bar: Bar | None = None
    css: str = ""

    @property
    def brackets(self) -> list[str]:
        """What stands in brackets behind the number."""
        return [part for part in (self.interval, self.count) if part]


MISSING = Cell(ABSENT, known=False)


@dataclass(frozen=True)
class Column:
    """The head of a column.

    Args:
        title: Title in words; the first column names the lines.
        numeric: Whether it is aligned right.
        css: Class of the colour of the variant whose numbers these are.
        bars: Whether bars stand below its numbers.
        minor: Left out on a phone.
    """

    title: str
    numeric: bool = True
    css: str = ""
    bars: bool = False
    minor: bool = False


@dataclass(frozen=True)
class Line:
    """One line of a table, and why it is as it is.

    Args:
        cells: One cell for each column.
        role, note: What the line stands for (``chosen``) and why, shown below it.
        best: Whether to point it out.
    """

    cells: tuple[Cell, ...]
    role: str = ""
    note: str = ""
    best: bool = False

    @property
    def remark(self) -> str:
        """Role and note with the name of the line; empty when there is neither."""
        name = f"{self.cells[0].text}, {self.role}" if self.role else self.cells[0].text
        return f"{name}: {self.note}" if self.note else name if self.role else ""


@dataclass(frozen=True)
class Table:
    """A table; blanks in the first column mean the text above.

    Args:
        columns: Heads.
        lines: Rows; formats cut long tables and say so.
        title: Above the table, when the section's own does not say it.
        beside: Title of the intervals, which then stand beside their numbers instead of below.
        style: How a page draws it: ``cards`` (a card for each line on a phone), ``percentiles``, ``small``, ``groups``,
            ``parts``.
    """

    columns: tuple[Column, ...]
    lines: tuple[Line, ...]
    title: str = ""
    beside: str = ""
    style: str = ""

    def __post_init__(self) -> None:
        wrong = next((len(line.cells) for line in self.lines if len(line.cells) != len(self.columns)), None)
        if wrong is not None:
            raise ValueError(f"a line has {wrong} cells, the table {len(self.columns)} columns")

    def filled_columns(self) -> list[int]:
        """Return the places of the columns that say something without bars."""
        return [
            index
            for index, column in enumerate(self.columns)
            if not index or column.title or any(line.cells[index].text for line in self.lines)
        ]


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Notes:
    """A list of sentences, under a title of its own when it has one; ``warning`` makes them stand out."""

    lines: tuple[str, ...]
    title: str = ""
    warning: bool = False


@dataclass(frozen=True)
class Pairs:
    """Names and what they are."""

    pairs: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Code:
    """A command, as it would be typed."""

    text: str


@dataclass(frozen=True)
class Chart:
    """A drawing, and what stands in its place where only text can be shown.

    Args:
        draw: Draws it at a width in pixels.
        caption: How to read it; shown with the drawing.
        alternative: A table in its place; None leaves the chart out.
    """

    draw: Callable[[int], Canvas]
    caption: str
    alternative: Table | None = None


Block = Text | Table | Notes | Pairs | Code | Chart


@dataclass(frozen=True)
class Section:
    """A part of the document.

    Args:
        title: Heading.
        blocks: Contents, in order.
        order: Sections stand in the order of this number: 10 predictions for a board, 20 variants, 90 further numbers,
            100 details, 130 environment.
        origin: ``measured``, ``predicted``, or empty for what is not a number.
        where: The origin in words; what was measured says on which machine, unless this does.
        about: A sentence or more on how to read it.
        brief: Whether a brief terminal report has it.
        folded: Whether Markdown folds it.
        anchor: Name for links to it.
    """

    title: str
    blocks: tuple[Block, ...]
    order: int
    origin: str = ""
    where: str = ""
    about: str = ""
    brief: bool = True
    folded: bool = False
    anchor: str = ""

    def __post_init__(self) -> None:
        if self.origin not in ("", "measured", "predicted"):
            raise ValueError(f"origin is {self.origin!r}; allowed: measured, predicted, or nothing")
        for block in self.blocks:
            if not isinstance(block, Block):
                raise ValueError(f"a block is {block!r}; allowed: Text, Table, Notes, Pairs, Code, Chart")


class Builder(Protocol):
    """What a file of ``sections`` defines."""

    def build(self, report: Report) -> Iterable[Section]:
        """Return the sections that the report has something for."""
        ...


@dataclass(frozen=True)
class Document:
    """A report, ready to be drawn.

    Args:
        report: Kind, title, verdict, time and command.
        result: The first sentence.
        sentences: The others of the summary.
        trust: Whether the measurement can be trusted, in a sentence.
        reasons: (effect, reason, remedy) of each finding.
        limits: (name, value) of what was asked for.
        sides: What was measured here beside what is predicted for the board.
        sections: Sections, in order.
    """

    report: Report
    result: str
    sentences: tuple[str, ...]
    trust: str
    reasons: tuple[tuple[str, str, str], ...]
    limits: tuple[tuple[str, str], ...]
    sides: Sides | None
    sections: tuple[Section, ...]

    @property
    def as_text(self) -> list[Section]:
        """The sections with tables in place of drawings, less those of which nothing is left."""
        texts = []
        for section in self.sections:
            blocks = (block.alternative if isinstance(block, Chart) else block for block in section.blocks)
            texts.append(replace(section, blocks=tuple(block for block in blocks if block is not None)))
        return [section for section in texts if section.blocks]


def build(report: Report) -> Document:
    """Return the document of a report; raises PluginError when a section of another package fails."""
    builders: list[Builder] = [registry.load("sections", name)() for name in registry.names("sections")]
    sections = [
        replace(section, where=section.where or (measured_where(report) if section.origin == "measured" else ""))
        for builder in builders
        for section in _sections(builder, report)
    ]
    first, *more = report.summary or (report.title,)
    return Document(
        report,
        first,
        tuple(more),
        _trust.sentence(report),
        tuple(_trust.reasons(report)),
        tuple(limit(name, value) for name, value in report.limits.items()),
        sides(report),
        tuple(sorted(sections, key=lambda section: section.order)),
    )


def _sections(builder: Builder, report: Report) -> list[Section]:
    try:
        return list(builder.build(report))
    except Exception as error:  # the seam: another package's code raises what it likes
        package = registry.plugin_of(type(builder).__module__)
        if not package or isinstance(error, PluginError):
            raise
        entry, why = registry.entry_of(type(builder)), f"{type(error).__name__}: {error}"
        raise PluginError(f"The package {package}, which adds '{entry}', fails: {why}.", "tell its authors") from error
