"""A bus recorded to a bag by another node, and the run of a controller replayed from it."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest

from tests._point_robot import GoTo, PointWorld
from vlatool import registry
from vlatool.buses import QoS, open_bus
from vlatool.errors import DataError, OutputError
from vlatool.messages.std_msgs import String
from vlatool.nodes.bus_recorder import BusRecorder
from vlatool.nodes.recordings import open_recording
from vlatool.nodes.replay import replay
from vlatool.nodes.session import RunPlan, run_on_bus
from vlatool.nodes.step_record import ControllerRecord, StepRecord
from vlatool.nodes.world_node import WorldNode

SETTINGS = {"rate_hz": 50, "goal_x": 0.05, "goal_y": 0}


def record(folder, name, address, monkeypatch, seconds=0.5):
    """Record a run of GoTo over a bus of this process; return the bag and the result."""
    load = registry.load
    monkeypatch.setattr(registry, "load", lambda kind, entry: GoTo if entry == "go-to" else load(kind, entry))
    buses = [open_bus(address, node) for node in ("robot", "recorder")]
    bag = open_bus(f"bag::{folder / name}", "recorder")
    world, recorder = WorldNode(PointWorld(), buses[0]), BusRecorder(buses[1], bag, "recorder")
    threads = [threading.Thread(target=work) for work in (world.run, recorder.run)]
    for thread in threads:
        thread.start()
    result = run_on_bus(RunPlan("go-to", SETTINGS, bus=address, seconds=seconds, wait_s=0.3, instruction="go"))
    recorder.stop()
    world.stop()
    for thread in threads:
        thread.join()
    for bus in (bag, *buses):
        bus.close()
    return folder / name.removesuffix(".mcap").removesuffix(".db3"), result


@pytest.mark.parametrize("name", ["run.mcap", "run.bag"])
def test_bag_of_another_node_is_replayed_bit_for_bit(tmp_path, monkeypatch, request, name):
    path, result = record(tmp_path, name, f"sim:{request.node.name}", monkeypatch)
    recording = open_recording(path, "go-to")
    assert recording.about.settings["goal_x"] == 0.05
    assert recording.about == result.about
    found = replay(GoTo(**SETTINGS), recording.items(), recording.topics)
    assert (found.equal, found.note, found.unheard) == (True, "", 0)
    assert found.steps == result.summary.steps
    assert replay(GoTo(**{**SETTINGS, "speed": 0.01}), recording.items(), recording.topics).differing > 0
    with pytest.raises(DataError, match=r"was recorded with 'go-to'.*not with 'vln'"):
        open_recording(path, "vln")


def test_wanted_topics_alone(tmp_path, request):
    buses = [open_bus(f"sim:{request.node.name}", node) for node in ("robot", "recorder")]
    bag = open_bus(f"bag::{tmp_path / 'run'}", "recorder")
    senders = [buses[0].publisher(topic, String, QoS(latched=True)) for topic in ("/a/controller", "/b")]
    for send in senders:
        send(String("x"))
    summary = BusRecorder(buses[1], bag, "recorder", ["/a/controller", "/a/contrller"]).run(0.15)
    assert summary.messages == {"/a/controller": 1}
    assert summary.unknown == {"/a/contrller": "nobody published it"}
    for bus in (bag, *buses):
        bus.close()
    with pytest.raises(DataError, match="cannot be read"):
        open_recording(tmp_path / "run", "go-to")
    with pytest.raises(OutputError, match="exists already"):
        open_bus(f"bag::{tmp_path / 'run'}", "recorder")


def bag_of(path, contents):
    bag = open_bus(f"bag::{path}", "recorder")
    for topic, text in contents:
        bag.publisher(topic, String, QoS())(String(text))
    bag.close()
    return path


@pytest.mark.parametrize(
    ("contents", "node", "words"),
    [
        ([("/words", "x")], "", "does not say which controller ran"),
        ([("/a/controller", ControllerRecord("go-to", node="a").to_json())], "", "lacks the topic /a/steps"),
        ([(f"/{name}/controller", ControllerRecord("go-to", node=name).to_json()) for name in "ab"], "",
         "has several runs of 'go-to': a, b"),
        ([("/a/controller", ControllerRecord("go-to", node="a").to_json())], "b", "has no run of the node 'b'; .*: a"),
    ],
)  # fmt: skip
def test_bags_that_hold_no_run_or_several(tmp_path, contents, node, words):
    with pytest.raises(DataError, match=words):
        open_recording(bag_of(tmp_path / "bag", contents), "go_to", node)


def test_run_of_one_of_two_nodes(tmp_path):
    about = ControllerRecord("go-to", node="a", topics={"odom": "/odom"})
    contents = [("/a/controller", about.to_json()), ("/b/controller", replace(about, node="b").to_json()),
                ("/a/steps", StepRecord(0, 1.0, (0, 0)).to_json())]  # fmt: skip
    recording = open_recording(bag_of(tmp_path / "bag", contents), "go-to", "a")
    assert list(recording.items()) == [StepRecord(0, 1.0, (0, 0))]


def test_first_of_two_runs_of_one_node_is_replayed(tmp_path):
    first = ControllerRecord("go-to", {**SETTINGS, "goal_x": 0.25}, {"odom": "/odom", "cmd": "/cmd_vel"}, node="a")
    steps = [("/a/steps", StepRecord(number, 1.0 + number, (0, 0)).to_json()) for number in (0, 1)]
    second = ("/a/controller", replace(first, settings=SETTINGS).to_json())
    recording = open_recording(
        bag_of(tmp_path / "bag", [("/a/controller", first.to_json()), *steps, second, *steps]), "go-to"
    )
    assert recording.about == first
    found = replay(GoTo(**recording.about.settings), recording.items(), recording.topics)
    assert (found.steps, found.note) == (2, "another run of the node begins, after step 1 of this one")
