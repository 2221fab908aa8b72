from __future__ import annotations

import math
import re

import pytest
from _render_reports import KINDS, compare, hostile, optimize, sustained
from rich.cells import cell_len

from vlatool.render import render
from vlatool.render.formats.terminal import TerminalRenderer
from vlatool.report import Measurement, Report, Row

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
    predicted, _, measured = text.partition("MEASURED on this host: AMD EPYC")
    assert "PREDICTED for raspberry-pi-5: computed by a model, not measured" in predicted
    assert "35.4 ms" not in measured
    assert "35.4 ms" in predicted
    assert "\nUnmeasured\n  float16, latency p50: engine refused\n" in measured
    assert "98.4 %" in measured
    assert "n = 1000" in measured
    assert "0.350 mm" in measured
    assert "90 %: " in measured
    assert "! The clock was not locked." in measured


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


def test_distrust_stands_below_the_result_with_its_remedy() -> None:
    first, *more = render(sustained(), "terminal").splitlines()
    assert first == "INFO  float32: 41.0 ms."
    assert [line.strip() for line in more[:4]] == [
        "The measurement is suspect: its numbers may be wrong.",
        "- suspect: The processor was throttled at 2 moments.",
        "Remedy: cool the board.",
        "- note: Its clock is not known.",
    ]


def test_percentiles_of_one_variant_are_one_table() -> None:
    text = render(sustained(1), "terminal")
    assert re.search(r"^latency, ms +float32 +at most \(99 %\)$", text, re.M)
    assert re.search(r"^p50 +4\d\.\d +≤ 4\d\.\d$", text, re.M)
    assert re.search(r"^p99\.9 +–$", text, re.M)
    assert "300 calls." in text
    assert re.search(r"^deadline misses +1\.2 % +0\.8–1\.7 +n = 2400$", text, re.M)
    assert re.search(r"^highest temperature +78\.5 °C$", text, re.M)
    assert text.count("latency p50") == 1


def test_percentiles_of_two_variants_stand_side_by_side() -> None:
    text = render(sustained(2), "terminal")
    assert re.search(r"^p50 +4\d\.\d  ≤ 4\d\.\d +1\d\.\d  ≤ 1\d\.\d$", text, re.M)
    assert "Beside each number: at most (99 %)." in text
    assert "300 calls each." in text


def test_why_a_percentile_is_missing_stands_once_and_below_the_percentiles() -> None:
    text = " ".join(render(sustained(2), "terminal").split())
    reason = "p99.9: needs 6,636 independent calls, this run is worth 1,204; pass --iterations 33000 300 calls each."
    assert text.count("6,636") == 1
    assert text.index("Latency percentiles") < text.index(reason) < text.index("How latency is spread")


def test_what_is_unmeasured_is_one_block_and_one_line_for_each_reason() -> None:
    text = render(sustained(2), "terminal")
    block = text.partition("\nUnmeasured\n")[2].partition("\n\n")[0]
    assert [line.strip() for line in block.splitlines()] == [
        "energy per action, mean power: no power meter",
        "GPU memory, GPU clock: no GPU",
    ]
    assert text.index("memory by part") < text.index("time by phase") < text.index("cold start by part")


@pytest.mark.parametrize(
    "tail", [[], [Measurement("latency_p99", math.nan, "ms")], [Measurement("latency_p99", 3.0, "ms")]]
)
def test_the_spread_has_a_column_for_the_tail_where_there_is_one(tail):
    rows = tuple(Row(name, measurements=tuple(tail), raw={"latency_ms": [1.0, 2.0] * 8}) for name in "ab")
    text = TerminalRenderer().render(Report("benchmark", "t", rows=rows))
    known = bool(tail) and tail[0].known
    (heads,) = (line for line in text.splitlines() if line.startswith("spread of latency"))
    assert heads.split("  ")[-1].strip() == ("latency p99" if known else "calls")
    assert ("n = 16" in text) != known
