"""A section is one file: the registry finds it, and every format draws it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from _render_reports import HOSTILE, KINDS, benchmark, optimize

from vlatool import registry
from vlatool.errors import MissingExtra, PluginError
from vlatool.render import render, sections
from vlatool.render.charts.svg import Canvas
from vlatool.render.document import Cell, Column, Line, Section, Table, Text, build
from vlatool.render.formats import html
from vlatool.render.formats.terminal import TerminalRenderer
from vlatool.report import Report, Row

PLANTED = """
from vlatool.render.charts.svg import Canvas
from vlatool.render.document import *

def drawing(width):
    canvas = Canvas(f"planted-{width}", width, 50, TEXT, TEXT)
    canvas.text(0, 20, TEXT, TEXT)
    canvas.add("path", TEXT, TEXT, d=TEXT)
    return canvas

class Planted:
    def build(self, report):
        table = Table((Column(TEXT, False), Column("grams")), (Line((Cell(TEXT), Cell("12 g")), TEXT, TEXT, True),),
                      TEXT, style=STYLE)
        heavy = Table((Column("thing"), Column("")), (Line((Cell("brick", bar=Bar(0.5)), Cell(bar=Bar(0.25, TEXT)))),))
        blocks = (table, Chart(drawing, TEXT, heavy), Text(TEXT), Notes((TEXT, "second note"), TEXT),
                  Notes((TEXT,), warning=True), Pairs(((TEXT, "pair value"),)), Code(TEXT))
        yield Section(TITLE, blocks, 25, "predicted", "Guessed, not measured", TEXT, anchor="planted")
"""
FORMATS = ("terminal", "markdown", "html")


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Callable[..., None]]:
    """A function that puts a file among the sections."""

    def write(text: str = "words", title: str = "Weight of it", style: str = "") -> None:
        head = f"TEXT, TITLE, STYLE = {text!r}, {title!r}, {style!r}\n"
        (tmp_path / "planted.py").write_text(head + PLANTED)

    sections.__path__.append(str(tmp_path))
    yield write
    sections.__path__.remove(str(tmp_path))
    sys.modules.pop("vlatool.render.sections.planted", None)


@pytest.mark.parametrize("style", ["", "cards", "groups"])
@pytest.mark.parametrize("format", FORMATS)
def test_one_file_adds_a_section_to_every_format(plant: Callable[..., None], format: str, style: str) -> None:
    before = render(benchmark(), format)
    assert "Weight of it" not in before
    plant(style=style)
    text = render(benchmark(), format)
    for words in ("Weight of it", "12 g", "second note", "pair value", "words"):
        assert words in text
    assert ("brick" in text) == (format != "html"), "a drawing, or the table in its place"
    assert text.count("<svg") - before.count("<svg") == (2 if format == "html" else 0)
    assert text.lower().index("guessed, not measured") < text.index("12 g")


@pytest.mark.parametrize("kind", KINDS)
def test_it_stands_at_its_place_in_every_report(plant: Callable[..., None], kind: str) -> None:
    plant()
    orders = [section.order for section in build(KINDS[kind]()).sections]
    assert orders == sorted(orders)
    assert 25 in orders


@pytest.mark.parametrize("style", ["", "cards", "groups", "parts", "small"])
def test_whatever_a_section_holds_is_text_on_the_page(plant: Callable[..., None], style: str) -> None:
    plant(HOSTILE, HOSTILE, style)
    page = render(benchmark(), "html")
    assert "<script" not in page
    assert "\x1b" not in page
    assert "\u202e" not in page
    assert HOSTILE not in page
    assert page.count("&lt;script&gt;") > 15
    assert "\x1b" not in render(benchmark(), "terminal")


def test_the_origin_of_a_section_is_measured_or_predicted() -> None:
    with pytest.raises(ValueError, match="allowed: measured, predicted"):
        Section("t", (Text("x"),), 1, "guessed")


def test_a_table_has_as_many_cells_in_each_line_as_columns() -> None:
    with pytest.raises(ValueError, match="a line has 1 cells, the table 2 columns"):
        Table((Column("a"), Column("b")), (Line((Cell("x"),)),))


def test_a_block_is_one_that_formats_draw() -> None:
    with pytest.raises(ValueError, match="a block is 'words'; allowed: Text, Table"):
        Section("t", ("words",), 1)  # type: ignore[arg-type]


@pytest.mark.parametrize("theirs", [False, True])
def test_a_section_that_fails_is_told_as_its_packages(
    plant: Callable[..., None], monkeypatch: pytest.MonkeyPatch, theirs: bool
) -> None:
    plant()
    monkeypatch.setattr(registry, "plugin_of", lambda module: "acme 1.2" if theirs and "planted" in module else "")
    registry.load("sections", "planted").build = lambda self, report: [Section("t", (Text("x"),), 1, "guessed")]
    with pytest.raises(PluginError if theirs else ValueError, match="allowed: measured, predicted") as caught:
        render(benchmark(), "terminal")
    assert ("The package acme 1.2, which adds 'sections.planted', fails: ValueError" in str(caught.value)) == theirs


def test_every_number_says_its_origin() -> None:
    for kind in KINDS.values():
        for section in build(kind()).sections:
            assert section.origin or section.title in ("Details", "Environment", "Warnings", "Reproduce", "Variants")


def test_no_two_files_begin_at_the_same_place() -> None:
    places: dict[int, str] = {}
    for name in registry.names("sections"):
        for kind in KINDS.values():
            for section in registry.load("sections", name)().build(kind()):
                assert places.setdefault(section.order, name) == name or {"boards"} & {name, places[section.order]}


def test_a_brief_report_is_a_part_of_the_whole_one() -> None:
    whole, brief = (TerminalRenderer(brief=brief).render(optimize()) for brief in (False, True))
    assert "Variants" in brief
    assert "Environment" in whole
    assert not any(words in brief for words in ("Environment", "Reproduce", "Details", "Further", "by dimension"))
    assert set(brief.splitlines()) <= set(whole.splitlines())


def test_a_canvas_escapes_what_it_is_given() -> None:
    canvas = Canvas("key", 10, 10, "<b>", "<i>")
    canvas.text(0, 0, "<u>", '"><script>')
    canvas.add("path", '"><script>', "<s>", d='"><script>')
    drawn = canvas.svg()
    assert "<script" not in drawn
    assert all(f"&lt;{letter}&gt;" in drawn for letter in "bius")


def test_html_alone_needs_jinja2(monkeypatch: pytest.MonkeyPatch) -> None:
    html.template.cache_clear()
    monkeypatch.setitem(sys.modules, "jinja2", None)
    for format in ("terminal", "markdown", "json", "junit", "github"):
        assert render(benchmark(), format)
    with pytest.raises(MissingExtra, match="'jinja2'"):
        render(benchmark(), "html")


def test_text_formats_do_not_load_it() -> None:
    code = (
        "import sys; from vlatool.render import render; from vlatool.report import Report; "
        "[render(Report('benchmark', 't'), format) for format in ('terminal', 'markdown', 'json', 'junit')]; "
        "print('jinja2' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_counts_that_all_numbers_share_stand_once() -> None:
    text = TerminalRenderer().render(optimize())
    table = text[text.index("Action error vs baseline") :].partition("\n\n")[0]
    assert table.count("n = 50") == 4
    rows = (Row("a"), Row("b"))
    assert "n =" not in TerminalRenderer().render(Report("compare", "t", rows=rows))
