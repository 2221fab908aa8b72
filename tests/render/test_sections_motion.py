"""The section on motion: what is drawn of rows with episodes, and nothing without any."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from vlatool.accuracy.disturbance_drops import with_disturbed
from vlatool.accuracy.success_comparison import Outcome, compare_success, success_row
from vlatool.render._format import label
from vlatool.render.formats.html import HtmlRenderer
from vlatool.render.formats.markdown import MarkdownRenderer
from vlatool.render.sections.motion import Motion
from vlatool.report import Report

TASKS = ("open", "close & <shut>")


def played(jerk: float, lost: int) -> list[Outcome]:
    return [Outcome(task, seed, seed >= lost, 40, "", {"jerk": jerk + seed, "task_time": 2.0})
            for task in TASKS for seed in range(20)]  # fmt: skip


@pytest.fixture
def report() -> Report:
    base = success_row("baseline", "baseline", played(10.0, 1))
    row = compare_success(base, success_row("int8", "subject", played(14.0, 3)))
    row = with_disturbed(row, {("delay", 2.0): played(1.0, 9)}, {("delay", 2.0): played(1.0, 4)})
    return Report("evaluate", "a title", rows=(base, row))


def test_ratios_tasks_and_disturbances_are_shown(report: Report):
    text = MarkdownRenderer().render(report)
    section = text[text.index("How it moves, and where it fails") :]
    assert re.search(r"\| jerk ratio \| 1\.\d+×", section)
    assert "| steps ratio |" in section
    assert re.search(r"\| delay \| 2 \| 40 \| 0\.8 \| 0\.55 \|", section)
    further = section[section.index("Further measurements") :]
    assert "jerk ratio |" not in further, "no number stands twice"
    assert "| jerk |" in further


def test_the_drawings_say_what_they_show_and_escape_names(report: Report):
    page = HtmlRenderer().render(report)
    assert "Success by task" in page
    assert "Success under disturbances" in page
    assert "close &amp; &lt;shut&gt;: " in page
    assert "<shut>" not in page
    assert "int8: 55 % (39.8 to 69.3 %) of 40 episodes" in page


def test_without_episodes_there_is_no_section():
    assert list(Motion().build(Report("benchmark", "a title"))) == []


@pytest.mark.parametrize("record", [
    {}, {"task": "a", "success": None, "episodes": 4}, {"task": "a", "success": "1", "episodes": 4},
    {"task": "a", "success": 0.5, "episodes": 0}, {"task": "a", "success": 7, "episodes": 4}, {"task": 5, "success": 1},
])  # fmt: skip
def test_tables_of_a_report_from_elsewhere_are_drawn_as_far_as_they_go(report: Report, record: dict[str, object]):
    base, row = report.rows
    broken = {"success by task": [record], "under disturbances": [record]}
    odd = replace(row, details={**row.details, **broken})
    page = HtmlRenderer().render(replace(report, rows=(base, odd)))
    assert "How it moves, and where it fails" in page


@pytest.mark.parametrize(("name", "shown"), [
    ("gripper_flips", "1.00"), ("turns", "1.00"), ("collisions", "1.00"), ("spectral_arc_length", "1.00"),
    ("reversals", "100.0 %"),
])  # fmt: skip
def test_a_count_is_no_percentage_and_a_share_is(name: str, shown: str):
    outcomes = [Outcome("open", seed, True, 40, "", {name: 1.0}) for seed in range(9)]
    report = Report("evaluate", "a title", rows=(success_row("int8", "subject", outcomes),))
    (line,) = (line for line in MarkdownRenderer().render(report).splitlines() if line.startswith(f"| {label(name)} "))
    assert line.split("|")[2].split("(")[0].strip() == shown
