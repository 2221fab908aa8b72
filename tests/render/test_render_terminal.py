from __future__ import annotations

import re

import pytest
from _render_reports import KINDS, compare, hostile, optimize
from rich.cells import cell_len

from vlatool.render import render
from vlatool.render.terminal import TerminalRenderer

ANSI = re.compile(r"\x1b\[[\d;]*m")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("width", [40, 80, 120])
@pytest.mark.parametrize("color", [False, True])
def test_no_line_is_wider_than_the_terminal(kind: str, width: int, color: bool) -> None:
    text = TerminalRenderer(width=width, color=color).render(KINDS[kind]())
    for line in text.splitlines():
        assert cell_len(ANSI.sub("", line)) <= width
    assert text.endswith("\n")


def test_first_line_is_the_result() -> None:
    assert render(optimize(), "terminal").startswith("PASS  static_int8 is 3.5 times as fast.\n")


def test_colour_only_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "20")
    plain = TerminalRenderer(color=False).render(optimize())
    assert "\x1b" not in plain
    assert ANSI.sub("", TerminalRenderer(color=True).render(optimize())) == plain
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b[" in TerminalRenderer(color=True).render(optimize())


def test_a_name_cannot_steer_the_terminal() -> None:
    assert "\x1b" not in render(hostile(), "terminal")
    assert "\u202e" not in render(hostile(), "terminal")


def test_blocks_are_labelled_and_apart() -> None:
    text = render(optimize(), "terminal")
    measured, _, predicted = text.partition("PREDICTED for raspberry-pi-5: computed by a model, not measured")
    assert "MEASURED on this host: AMD EPYC" in measured
    assert "35.4 ms" not in measured
    assert "35.4 ms" in predicted
    assert "unmeasured: float16, latency p50: engine refused" in measured
    assert "98.4 %" in measured
    assert "n = 1000" in measured
    assert "0.350 mm" in measured
    assert "90 %: " in measured
    assert "! The clock was not locked." in predicted


def test_wide_tables_continue_below_under_the_same_names() -> None:
    text = render(compare(), "terminal")
    assert text.count("dream depth") >= 2
    assert "candidate-with-a-rather-long-name-8" in text


def test_a_renderer_can_be_used_again() -> None:
    renderer = TerminalRenderer()
    assert renderer.render(optimize()) == renderer.render(optimize())


def test_long_details_are_cut() -> None:
    assert "more rows in report.json" not in render(optimize(), "terminal")
    from vlatool.report import Report, Row

    table = [{"episode": index} for index in range(30)]
    text = render(Report("evaluate", "many", rows=(Row("a", details={"episodes": table}),)), "terminal")
    assert "… 6 more rows in report.json" in text
