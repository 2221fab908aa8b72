"""Success against the strength of disturbances: a curve for each variant, from what was played undisturbed."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from vlatool.accuracy.disturbance_drops import drops_by_disturbance, with_disturbed, worst_record
from vlatool.accuracy.success_comparison import Outcome, compare_success, success_row
from vlatool.render.formats.html import HtmlRenderer
from vlatool.render.formats.markdown import MarkdownRenderer
from vlatool.report import Report, Row

STRENGTHS = (0.5, 1.0, 2.0)


def played(lost: int) -> list[Outcome]:
    return [Outcome("push", seed, seed >= lost, 40) for seed in range(20)]


def rows(kinds: dict[str, int], strengths: tuple[float, ...] = STRENGTHS) -> tuple[Row, Row]:
    """The variant loses so many episodes more at each strength under a kind; the baseline none."""
    base = success_row("baseline", "baseline", played(1))
    row = compare_success(base, success_row("int8", "subject", played(2)))
    own = {(kind, strength): played(2 + more * number)
           for kind, more in kinds.items() for number, strength in enumerate(strengths, 1)}  # fmt: skip
    return base, with_disturbed(row, own, {key: played(1) for key in own})


@pytest.fixture
def report() -> Report:
    return Report("evaluate", "a title", rows=rows({"light": 1, "delay & <co>": 4}))


def drawing(page: str) -> str:
    """The first drawing of the curves."""
    found = re.search(r'<svg[^>]*aria-labelledby="curves-.*?</svg>', page, re.DOTALL)
    assert found
    return found[0]


def test_each_disturbance_has_a_curve_of_each_variant_from_the_undisturbed_on(report: Report):
    svg = drawing(HtmlRenderer().render(report))
    lines = re.findall(r'<path[^>]*d="(M[^"]+)"[^>]*class="line', svg) or re.findall(r'class="line[^>]*', svg)
    assert len(lines) == 4
    assert svg.count('class="dot') == 4 * 4 + 2, "four strengths, and the legend"
    assert svg.count('class="whisker') == 4 * 4
    for tick in ("0", "0.5", "1", "2"):
        assert f">{tick}</text>" in svg
    assert "light at strength 2: int8: 75 % (53.1 to 88.8 %) of 20 episodes" in svg
    assert "light at strength 0: int8: 90 %" in svg
    assert "light at strength 0: baseline: 95 %" in svg
    assert "delay &amp; &lt;co&gt;" in svg
    assert svg.index("delay") < svg.index("light"), "the worst first"


def test_a_single_strength_has_dots_and_no_curves():
    page = HtmlRenderer().render(Report("evaluate", "a title", rows=rows({"light": 1}, (2.0,))))
    assert "curves-" not in page
    assert "shares-under" in page


def test_the_table_has_each_strength_in_order_and_the_worst_kind_first(report: Report):
    table = report.rows[-1].details["under disturbances"]
    assert [(line["disturbance"], line["strength"]) for line in table] == [
        *(("delay & <co>", strength) for strength in STRENGTHS), *(("light", strength) for strength in STRENGTHS)
    ]  # fmt: skip
    assert [line["drop"] for line in table] == [0.25, 0.45, 0.65, 0.1, 0.15, 0.2]
    worst, words = worst_record(report.rows[-1]) or ({}, "")
    assert (worst["success"], words) == (0.3, "delay & <co> at strength 2")
    assert "| light | 0.5 | 20 |" in MarkdownRenderer().render(report)


def test_each_strength_has_raw_outcomes_and_a_drop_of_its_own(report: Report):
    row = report.rows[-1]
    assert sum(row.raw["disturbed.light at 2"]) == 15
    assert sum(row.raw["disturbed.light at 2, baseline"]) == 19
    drops = drops_by_disturbance(row)
    assert drops["light at 0.5"].value == pytest.approx(0.1)
    assert len(drops) == 6
    assert row.get("success_disturbed").samples == 120
    assert row.get("success_disturbed").note == "under light, delay & <co>; strength 0.5, 1, 2"
    one = rows({"light": 1}, (2.0,))[-1]
    assert "disturbed.light" in one.raw, "a single strength is named as it was before there were several"
    assert (worst_record(one) or ({}, ""))[1] == "light"


@pytest.mark.parametrize("strength", [None, "2", float("nan"), -1, 1e300, True])
def test_a_strength_from_elsewhere_breaks_nothing(report: Report, strength: Any):
    base, row = report.rows
    table = [{**line, "strength": strength} if number == 0 else line
             for number, line in enumerate(row.details["under disturbances"])]  # fmt: skip
    odd = replace(row, details={**row.details, "under disturbances": table})
    svg = drawing(HtmlRenderer().render(replace(report, rows=(base, odd))))
    assert "nan" not in svg


def test_all_drawings_are_small(report: Report):
    kinds = {f"kind_{number}": number % 3 for number in range(12)}
    page = HtmlRenderer().render(replace(report, rows=rows(kinds, (0.25, 0.5, 1.0, 1.5, 2.0, 3.0))))
    assert len(page.encode()) < 300_000
