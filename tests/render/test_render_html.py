from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from _render_reports import HOSTILE, KINDS, compare, evaluate, hostile, optimize, profile, sustained

from vlatool.render import _view, render
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
        "<h1", "badge pass", 'class="sides"', "limits asked for", "Predicted for raspberry-pi-5",
        "Predicted for jetson-orin-nano", "Variants", "How latency is spread",
        "Success against latency p50", "Action error vs baseline by dimension", "Details", "Latency along the run",
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


def test_a_reason_in_brackets_breaks_anywhere_and_an_interval_does_not() -> None:
    """One line of it is wider than a phone."""
    note = "no interval: too few pairs in which the baseline's is not 0"
    shown = (Measurement("jerk_ratio", 2.0, "x", samples=9, note=note), Measurement("path_ratio", 1.0, "x", samples=9))
    page = render(Report("evaluate", "Motion", "info", ("Seen.",), (Row("int8", measurements=shown),)), "html")
    assert "no interval: too few pairs" in page
    assert "<b>(no interval" not in page
    assert "<b>n = 9)</b>" in page


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


def test_distrust_stands_in_the_head() -> None:
    page = render(sustained(), "html")
    head = page[page.index("<header>") : page.index("</header>")]
    assert '<div class="trust suspect"><p>The measurement is suspect: its numbers may be wrong.</p>' in head
    assert head.index("throttled at 2 moments.") < head.index("Remedy: cool the board.") < head.index("Its clock")
    assert 'class="trust' not in render(optimize(), "html")
    valid = render(replace(sustained(), validity="valid", findings=()), "html")
    assert '<div class="trust valid"><p>The measurement is valid.</p></div>' in valid


def test_percentiles_with_bounds_and_the_reason_for_what_is_missing() -> None:
    (text,) = (text for text in parse(render(sustained(1), "html")).sections if "Latency percentiles" in text)
    assert "at most (99 %)" in text
    assert re.search(r"p504\d\.\d≤ 4\d\.\d", text)
    assert "p99.9––" in text
    assert "p99.9: needs 6,636 independent calls" in text
    both = render(sustained(2), "html")
    assert both.count("needs 6,636 independent calls") == 1


def test_time_line_has_seconds_gauges_and_throttled_moments() -> None:
    page = render(sustained(), "html")
    assert page.count('id="time-996-t"') == 1
    assert "Latency along the run" not in page
    drawing = page[page.index('id="time-996-t"') :].partition("</svg>")[0]
    assert "seconds since the start of the run" in drawing
    assert "throttled: 4 moments" in drawing
    names = ["thermal.cpu-thermal, float32", "thermal.cpu-thermal, static_int8", "cpufreq.policy0, float32",
             "cpufreq.policy0, static_int8", "ina3221.VDD_IN, float32", "ina3221.VDD_IN, static_int8"]  # fmt: skip
    assert [drawing.index(name) for name in names] == sorted(drawing.index(name) for name in names)
    assert "°C" in drawing
    ticks = [float(text) for text in re.findall(r'class="tick">([\d.]+)</text>', drawing)]
    assert max(ticks) >= 20  # 300 calls of 41 ms, two policies in turns: 24.6 s


def test_gauges_that_two_rows_share_are_drawn_once() -> None:
    report = sustained()
    shared = {name: series for name, series in report.rows[0].raw.items() if name.startswith("telemetry.")}
    rows = (report.rows[0], replace(report.rows[1], raw={**report.rows[1].raw, **shared}, details={}))
    drawing = render(replace(report, rows=rows), "html").partition('id="time-996-t"')[2].partition("</svg>")[0]
    assert drawing.count(">thermal.cpu-thermal<") == 1
    assert "thermal.cpu-thermal, " not in drawing


def test_gauges_beyond_the_room_are_counted() -> None:
    row = profile("a", "subject", 10.0)
    more = {f"telemetry.g{place}": [1.0, 2.0] for place in range(5)}
    times = {f"telemetry.g{place}.at_s": [0.0, 1.0 + place] for place in range(5)}
    page = render(Report("benchmark", "t", rows=(replace(row, raw={**row.raw, **more, **times}),)), "html")
    assert page.count("2 more gauges in report.json.") == 1


@pytest.mark.parametrize(
    "times",
    [[], [1.0], [0.0] * 300, [300.0 - index for index in range(300)], [-1.0 + index for index in range(300)],
     [float("nan"), *map(float, range(299))]],
)  # fmt: skip
def test_without_usable_times_latency_is_drawn_along_the_run(times: list[float]) -> None:
    row = profile("a", "subject", 10.0)
    page = render(Report("benchmark", "t", rows=(replace(row, raw={**row.raw, "at_s": times}),)), "html")
    assert "Latency along the run" in page
    assert "Latency over time" not in page
    assert "first sample" in page


def test_a_lost_sample_takes_its_time_with_it() -> None:
    row = profile("a", "subject", 10.0)
    lost = [None if index == 7 else sample for index, sample in enumerate(row.raw["latency_ms"])]
    page = render(Report("benchmark", "t", rows=(replace(row, raw={**row.raw, "latency_ms": lost}),)), "html")
    assert "Latency over time" in page
    assert "n = 299" in page


def test_bars_show_each_part_with_its_number() -> None:
    page = render(sustained(1), "html")
    (text,) = (text for text in parse(page).sections if "Where memory and time go" in text)
    assert "weights88.2540the rest132.4060" in text
    bars = page[page.index("Where memory and time go") :].partition("</section>")[0]
    widths = [float(width) for width in re.findall(r'<i style="width:([\d.]+)%', bars)]
    assert widths == [66.7, 100.0, 5.3, 100.0, 60.0, 100.0]
    assert page.count("memory by part") + page.count("Memory by part") == 1


def test_the_deadline_is_marked() -> None:
    assert "deadline 50 ms" in render(sustained(), "html")
    paced = replace(sustained(), limits={"hz": 25})
    assert "deadline 40 ms" in render(paced, "html")
    assert "deadline 40 ms" not in render(replace(paced, kind="optimize"), "html")
    assert "deadline 40 ms" not in render(replace(paced, limits={"hz": True}), "html")


@pytest.mark.parametrize(
    ("name", "chosen"),
    [("latency_p99.9_ms", "latency_p99.9"), ("latency_max_ms", "latency_max"), ("max_latency_ms", "latency_p50"),
     ("deadline_ms", "latency_p50"), ("latency_p42_ms", "latency_p50")],
)  # fmt: skip
def test_the_limit_speaks_of_a_percentile(name: str, chosen: str) -> None:
    found = _view.latency(replace(sustained(), limits={name: 33, "hz": 20}))
    assert found.quantity.name == chosen
    assert found.limit == (50 if "p42" in name else 33)


def test_memory_stands_in_where_accuracy_is_not_known() -> None:
    page = render(sustained(), "html")
    assert "Peak memory against latency p50" in page
    assert "Down and to the left is better" in page
    assert "against latency p50" not in render(sustained(1), "html")


def test_one_call_is_shown_without_charts() -> None:
    page = render(KINDS["one-call"](), "html")
    assert "<svg" not in page
    assert "Latency percentiles" in page


def test_page_stays_small_with_a_long_run() -> None:
    page = render(sustained(2, 200_000, 20_000), "html")
    assert len(page.encode()) <= 300_000
    assert not parse(page).faults
    assert "200\u202f000" in page
