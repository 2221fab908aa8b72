from __future__ import annotations

import re

import pytest
from _render_reports import KINDS, hostile, optimize, sustained

from vlatool.render import render
from vlatool.render.formats.markdown import inline
from vlatool.report import Report, Row


def tables(text: str) -> list[list[str]]:
    return [block.strip().splitlines() for block in text.split("\n\n") if block.startswith("|")]


def cells(line: str) -> int:
    return len(re.split(r"(?<!\\)\|", line.strip())) - 2


@pytest.mark.parametrize("kind", KINDS)
def test_tables_have_the_same_columns_in_each_line(kind: str) -> None:
    text = render(KINDS[kind](), "markdown")
    for table in tables(text):
        assert re.fullmatch(r"\|( (:---|---:) \|)+", table[1])
        assert len({cells(line) for line in table}) == 1
    assert text.count("<details>") == text.count("</details>")
    assert text.endswith("\n")


def test_hostile_names_are_text() -> None:
    text = render(hostile(), "markdown")
    assert "<script" not in text.split("```")[0]
    assert inline("a|b\n`c`<d>_e_") == "a\\|b \\`c\\`&lt;d&gt;\\_e\\_"
    assert not re.search(r"(?<!\\)\]\(", text.split("\n```")[0])


def test_a_command_cannot_leave_its_fence() -> None:
    text = render(Report("benchmark", "t", command="echo ```` # x"), "markdown")
    assert "\n`````\necho ```` # x\n`````\n" in text


def test_headline_measured_and_predicted() -> None:
    text = render(optimize(), "markdown")
    assert text.startswith("### ✅ PASS: static\\_int8 is 3.5 times as fast.")
    assert "98.4 % (97.4–99.0, n = 1000)" in text
    measured = text.index("**Variants** (measured on this host: AMD EPYC).")
    predicted = text.index("**Predicted for raspberry-pi-5** (computed by a model, not measured).")
    assert predicted < text.index("35.4 ms (23.6–59.0)") < measured
    assert "(computed by a model, not measured)" in text
    assert "unmeasured: engine refused" in text
    assert "Asked for: latency p50 25 ms, max success drop 2 points, strict yes" in text


def test_long_details_are_cut() -> None:
    table = [{"episode": index} for index in range(70)]
    assert "10 more rows" in render(Report("evaluate", "m", rows=(Row("a", details={"e": table}),)), "markdown")


def test_distrust_and_percentiles() -> None:
    text = render(sustained(), "markdown")
    assert "**⚠️ The measurement is suspect: its numbers may be wrong.**" in text
    assert "- *suspect*: The processor was throttled at 2 moments. Remedy: cool the board.\n- *note*: Its clock" in text
    assert "| latency, ms | float32 | at most (99 %) | static\\_int8 | at most (99 %) |" in text
    assert "| p99.9 | – | – | – | – |" in text
    assert "- energy per action, mean power: no power meter\n- GPU memory, GPU clock: no GPU" in text
