from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from _render_reports import HOSTILE, KINDS, compare, evaluate, hostile, optimize

from vlatool.render import render
from vlatool.report import Measurement, Report, Row

VOID = {"meta", "br", "wbr", "hr"}


class Balance(HTMLParser):
    """Collects what is open, what was wrong, ids, and the text by section."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.faults: list[str] = []
        self.ids: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.sections: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.ids += [value for key, value in attrs if key == "id" and value]
        if tag == "section":
            self.sections.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> at {self.getpos()}")

    def handle_data(self, data: str) -> None:
        if self.sections and "section" in self.open:
            self.sections[-1] += data


def parse(page: str) -> Balance:
    balance = Balance()
    balance.feed(page)
    balance.close()
    return balance


@pytest.mark.parametrize("kind", KINDS)
def test_page_is_well_formed_and_needs_nothing_from_outside(kind: str) -> None:
    page = render(KINDS[kind](), "html")
    found = parse(page)
    assert not found.faults
    assert not found.open
    assert len(found.ids) == len(set(found.ids))
    assert not re.search(r"https?:|//\w|url\(|@import|<script|<link|<img|<iframe|javascript:", page, re.I)
    assert not any(key.startswith("on") for _, attributes in found.tags for key in attributes)
    assert "nan" not in re.sub(r"jetson-orin-nano|[^\W\d_]+nan|nan[^\W\d_]+", "", page)


@pytest.mark.parametrize("kind", KINDS)
def test_page_is_accessible(kind: str) -> None:
    page = render(KINDS[kind](), "html")
    found = parse(page)
    assert all("scope" in attributes for tag, attributes in found.tags if tag == "th")
    for tag, attributes in found.tags:
        if tag == "svg":
            assert attributes["role"] == "img"
            assert set((attributes["aria-labelledby"] or "").split()) <= set(found.ids)
    assert page.count("<h1") == 1
    assert '<html lang="en">' in page


def test_hostile_names_are_text() -> None:
    page = render(hostile(), "html")
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert not any(ord(char) < 32 and char != "\n" for char in page)
    assert "\u202e" not in page


def test_page_stays_small_with_many_samples() -> None:
    page = render(optimize(samples=5000), "html")
    assert len(page.encode()) <= 300_000


def test_page_stays_small_with_many_details() -> None:
    table = [{"episode": index, "steps": index / 7, "won": True} for index in range(5000)]
    page = render(Report("evaluate", "many", rows=(Row("a", details={"episodes": table}),)), "html")
    assert len(page.encode()) <= 300_000
    assert "4800 more rows in report.json" in page


def test_order_of_the_parts() -> None:
    page = render(optimize(), "html")
    order = [
        "<h1", "badge pass", "limits asked for", "Variants", "How latency is spread",
        "Success against latency p50", "Action error vs baseline by dimension", "Details",
        "Predicted for raspberry-pi-5", "Predicted for jetson-orin-nano", "Latency along the run",
        "Environment", "Warnings", "Reproduce",
    ]  # fmt: skip
    places = [page.index(text) for text in order]
    assert places == sorted(places)
    assert "report.json" in page
    assert "vlatool optimize policy.py:make" in page


def test_measured_and_predicted_never_share_a_section() -> None:
    sections = parse(render(optimize(), "html")).sections
    predicted = [text for text in sections if text.startswith("predicted")]
    assert len(predicted) == 2
    assert all("Computed by a model, not measured" in text for text in predicted)
    assert "35.4 ms" in predicted[0]
    assert "(23.6–59.0)" in predicted[0]
    for text in sections:
        if text not in predicted:
            assert "35.4 ms" not in text
            assert "roofline" not in text
    for text in sections:
        if text.startswith("measured"):
            assert "on this host: AMD EPYC" in text or "by dimension" in text


def test_headline_numbers_with_intervals_and_counts() -> None:
    page = render(optimize(), "html")
    assert "98.4 %" in page
    assert "<b>(97.4–99.0</b>, <b>n = 1000)</b>" in page
    assert "0.3 points" in page
    assert "0.350 mm" in page
    assert "12\u202f346 fathom" in page
    assert "unless marked" in page
    assert "90 %:" in page
    assert "engine refused" in page
    assert 'class="chosen-row"' in page


def test_numbers_from_several_places_say_where() -> None:
    page = render(evaluate(), "html")
    assert "pi.local" in page
    assert page.count("this host") >= 2
    assert "Agreement vs expert" in page


def test_accuracy_may_be_an_error_that_is_better_when_small() -> None:
    rows = tuple(
        Row(name, role, measurements=(Measurement("latency_p50", x, "ms"), Measurement("error_expert", y, "1")))
        for name, role, x, y in (("a", "baseline", 40.0, 0.1), ("b", "chosen", 2.0, 0.1), ("c", "within", 3.0, 0.3))
    )
    page = render(Report("compare", "errors", rows=rows), "html")
    assert "better is up: smaller" in page
    assert "latency p50, ms (logarithmic)" in page


def test_limit_on_another_percentile_moves_the_chart() -> None:
    page = render(compare(), "html")
    assert "Success against latency p99" in page
    assert "limit 7 ms" in page
    assert "at least 95 %" in page
    assert page.count("Only the first 8 variants are drawn; 1 more in the tables.") == 2


def test_drop_as_a_share_draws_the_same_floor() -> None:
    report = optimize()
    shares = replace(report, limits={"max_success_drop": 0.02})
    assert "at least 96.4 %" in render(report, "html")
    assert "at least 96.4 %" in render(shares, "html")
    without = replace(shares, rows=report.rows[1:])
    assert "at least" not in re.sub(r"that were at least", "", render(without, "html"))


def test_constant_samples_can_be_drawn() -> None:
    rows = (Row("a", raw={"latency_ms": [2.0] * 50}), Row("b", raw={"latency_ms": [0.0] * 9}), Row("c"))
    page = render(Report("benchmark", "constant", rows=rows), "html")
    assert not parse(page).faults
    assert page.count("<svg") == 4


def test_hostile_text_reaches_attributes_only_escaped() -> None:
    page = render(hostile(), "html")
    assert HOSTILE not in page
    assert not re.search(r'data-label="[^"]*<', page)
