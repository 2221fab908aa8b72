"""The HTML report of a run: its drawings, and what is in them is escaped."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import pytest

from tests._point_robot import GoTo, PointWorld
from vlatool.buses import QoS, open_bus
from vlatool.controllers import Command, Snapshot
from vlatool.errors import OutputError
from vlatool.messages.std_msgs import String
from vlatool.nodes import trace as trace_module
from vlatool.nodes.in_world import play
from vlatool.nodes.report_page import page, write_page
from vlatool.nodes.runner import RunSummary
from vlatool.nodes.session import RunResult
from vlatool.nodes.step_record import ControllerRecord
from vlatool.nodes.stepper import StepReport
from vlatool.nodes.trace import Trace, phases, watch_levels

ABOUT = ControllerRecord("go-to", {"goal_x": 1.0}, {"odom": "/odom"}, "vlatool_go_to", version="1")


@pytest.fixture
def run():
    trace, summary = Trace(), RunSummary()
    for report in play(PointWorld(), [GoTo()], seconds=8).steps[0]:
        trace(report)
        summary.add(report)
    return RunResult(ABOUT, summary), trace


def test_page_draws_path_states_and_times(run, tmp_path):
    text = page(*run)
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    assert titles == ["Path from above", "Statuses and levels", "Latencies and speeds", "Times of the steps", "Topics",
                      "Settings"]  # fmt: skip
    drawings = re.findall(r"<svg.*?</svg>", text, re.S)
    assert len(drawings) == 6
    for drawing in drawings:
        ElementTree.fromstring(drawing)
    assert "going" in drawings[2]
    assert "there" in drawings[2]
    assert "normal" in drawings[2]
    write_page(tmp_path / "run.html", *run)
    with pytest.raises(OutputError, match="exists already"):
        write_page(tmp_path / "run.html", *run)


def test_levels_of_a_monitor_are_drawn(run):
    result, trace = run
    bus = open_bus("sim:levels", "monitor")
    say = bus.publisher("/safety_monitor/level", String, QoS(depth=9))
    other = open_bus("sim:levels", "vlatool_go_to")
    watch_levels(other, trace)
    for text in ("NORMAL", "NORMAL", "WARNING /scan", "EMERGENCY person"):
        say(String(text))
        assert other.settle(5)
    for each in (bus, other):
        each.close()
    words = [word for _, word in trace.levels["/safety_monitor/level"]]
    assert words == ["NORMAL", "WARNING", "EMERGENCY"]
    trace.levels["/safety_monitor/level"] = [(trace.first_s + 2 * index, word) for index, word in enumerate(words)]
    assert "EMERGENCY, 4.0 to 7.9 s" in page(result, trace)


def test_what_others_say_of_their_levels_takes_no_more_than_its_share(run, monkeypatch):
    monkeypatch.setattr("vlatool.nodes.trace.MAX_CHANGES", 50)
    bus, trace = open_bus("sim:many-levels", "monitor"), Trace()
    say = bus.publisher("/evil/level", String, QoS(depth=200))
    watch_levels(bus, trace)
    for number in range(120):
        say(String(f"{number}{'x' * 100_000}"))
    assert bus.settle(5)
    bus.close()
    heard = [word for _, word in trace.levels["/evil/level"]]
    assert len(heard) <= 50
    assert heard[-1].startswith("119x")
    assert max(map(len, heard)) < 200


def test_statuses_are_kept_in_part(run):
    report = StepReport(0, Snapshot(0.0), Command(status="late " + "x" * 100_000, notes={"why": "y" * 100_000}))
    trace = Trace()
    trace(report)
    assert len(trace.points[0].status) < 500
    assert len(trace.points[0].notes["why"]) < 500


def test_texts_are_escaped(run):
    result, trace = run
    trace.points[3] = trace.points[3]._replace(status="<script>alert(1)</script>", notes={"<b>": "<i>"})
    text = page(replace(result, about=replace(ABOUT, settings={"x": "<u>"})), trace)
    assert not re.search(r"<(script|b|i|u)>", text)


def test_page_of_a_run_that_never_stepped():
    assert "0 steps" in page(RunResult(ABOUT, RunSummary()), Trace())


def test_phases_join_steps_with_the_same_word(run):
    _, trace = run
    assert [word for _, _, word in phases(trace.points)][:1] == ["going"]
    assert [word for _, _, word in phases(trace.points, "level")] == ["normal"]


def test_long_runs_are_thinned(monkeypatch):
    monkeypatch.setattr(trace_module, "MAX_POINTS", 200)
    report = play(PointWorld(), [GoTo()], seconds=0.1).steps[0][0]
    long = Trace()
    for _ in range(410):
        long(report)
    assert 100 < len(long.points) <= 201
    assert long.steps == 410
