"""Logs of runs, and their replay: bit-equal commands, the first difference, and recordings that are not whole."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from tests._point_robot import Exchange, GoTo, MemoryBus, PointWorld
from vlatool.buses import QoS
from vlatool.errors import DataError
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import Bool, String
from vlatool.nodes.content import digest, from_text, to_text
from vlatool.nodes.in_world import Event, play
from vlatool.nodes.recordings import open_recording
from vlatool.nodes.replay import lines, replay
from vlatool.nodes.run_log import Background, Received, RunLog, StepPublisher, is_log, read_log
from vlatool.nodes.step_record import ControllerRecord, StepRecord
from vlatool.runtime.telemetry.run_file import Frame, FrameKind, RunWriter

ABOUT = ControllerRecord("go-to", {"goal_x": 1.0}, {"odom": "/odom"}, "vlatool_go_to")


@pytest.fixture(scope="module")
def reports():
    events = [Event(1.0, "/instruction", String("a")), Event(1.02, "/instruction", String("b")),
              Event(2.0, "/halt", Bool(True), call=True), Event(2.5, "/halt", Bool(False), call=True)]  # fmt: skip
    return play(PointWorld(), [GoTo()], seconds=4, events=events).steps[0]


@pytest.fixture
def log(reports, tmp_path):
    path = tmp_path / "run.vla"
    log = RunLog(path, ABOUT)
    for report in reports:
        log(report)
    log.close()
    return path


def test_log_is_replayed_bit_for_bit(log, reports):
    assert is_log(log)
    items = list(read_log(log))
    assert items[0] == ABOUT
    found = replay(GoTo(), items, None)
    assert (found.equal, found.steps, found.differing, found.unused, found.note) == (True, len(reports), 0, 0, "")
    assert found.messages == sum(len(messages) for report in reports for messages in report.command.messages.values())
    assert list(lines(found)) == [f"{found.steps} steps, {found.messages} messages of commands: bit-equal"]


def test_log_is_one_by_its_bytes_whatever_its_name(log):
    named = log.rename(log.with_name("run.mcap"))
    recording = open_recording(named, ABOUT.controller)
    assert recording.topics is None
    assert next(iter(recording.items())) == ABOUT


def test_other_settings_differ(log):
    found = replay(GoTo(speed=0.39), read_log(log), None)
    assert not found.equal
    assert (found.difference.step, found.difference.output) == (0, "cmd")
    assert isinstance(from_text(found.difference.recorded), Twist)
    assert found.differing < found.steps  # it stood while it was halted
    text = list(lines(found))
    assert "steps differ, the first is 0, 'cmd'" in text[0]
    assert text[1] != text[2]


def test_one_bit_in_one_command_is_found(log):
    items = []
    for item in read_log(log):
        if isinstance(item, StepRecord) and item.step == 7:
            changed = item.messages["cmd"][0]
            item = replace(item, messages={**item.messages, "cmd": (changed[:-20] + "1" + changed[-19:],)})
        items.append(item)
    found = replay(GoTo(), items, None)
    assert (found.differing, found.difference.step) == (1, 7)


@pytest.mark.parametrize(
    ("change", "output"),
    [
        ({"status": "arrived"}, "status of the step"),
        ({"responses": {"0": to_text(Bool(True))}}, "response 0"),
    ],
)
def test_a_status_and_an_answer_that_were_not_given_are_found(log, change, output):
    items = [replace(item, **change) if isinstance(item, StepRecord) and item.step == 7 else item
             for item in read_log(log)]  # fmt: skip
    found = replay(GoTo(), items, None)
    assert (found.equal, found.differing, found.difference.step, found.difference.output) == (False, 1, 7, output)
    assert any("recorded" in line for line in lines(found))


def test_a_record_of_a_message_that_is_none_is_shown_as_it_is(log):
    items = [replace(item, messages={"cmd": ("a=b",)}) if isinstance(item, StepRecord) and item.step == 7 else item
             for item in read_log(log)]  # fmt: skip
    assert "  recorded  a=b" in list(lines(replay(GoTo(), items, None)))


def test_a_log_without_its_end_says_so(log, reports):
    content = log.read_bytes()
    for size in (len(content) - 1, len(content) // 2):
        log.write_bytes(content[:size])
        found = replay(GoTo(), read_log(log), None)
        assert found.equal
        assert found.note == "the log has no end: its process was killed, or the file was cut"


def test_why_a_log_is_not_whole_is_said(log, reports, tmp_path):
    short = RunLog(tmp_path / "short.vla", ABOUT, max_bytes=log.stat().st_size // 2)
    for report in reports:
        short(report)
    short.close()
    assert replay(GoTo(), read_log(tmp_path / "short.vla"), None).note == "the log was full"


def test_logs_one_behind_the_other_are_refused(log):
    log.write_bytes(2 * log.read_bytes())
    with pytest.raises(DataError, match="bytes follow its end"):
        list(read_log(log))


@pytest.mark.parametrize("fate", ["kept", "lost", "altered"])
def test_a_recorded_command_that_is_another_than_its_step_sent_is_found(log, fate):
    items, topics = [], {"odom": "odom", "instruction": "instruction", "cmd": "/cmd"}
    for item in read_log(log):
        items.append(item)
        for text in item.messages.get("cmd", ()) if isinstance(item, StepRecord) else ():
            message = from_text(text)
            if item.step == 7:
                message = {"kept": message, "lost": None, "altered": Twist(Vector3(9.0))}[fate]
            items += [] if message is None else [Received("/cmd", message, digest(message))]
    rest = GoTo().rest().messages["cmd"][0]
    items.append(Received("/cmd", rest, digest(rest)))  # what a node sends last is in no step
    found = replay(GoTo(), items, topics)
    assert (found.equal, found.differing) == (fate != "altered", 0)
    assert (found.unheard, found.altered) == {"kept": (0, 0), "lost": (1, 0), "altered": (1, 1)}[fate]
    assert any("that no step sent" in line for line in lines(found)) == (fate == "altered")


def test_bag_order_may_differ_by_a_little(log):
    """A recorder in another process may write a record before a message that it was made from."""
    items = [Received("/odom", item.message, item.digest) if isinstance(item, Received) and item.channel == "odom"
             else item for item in read_log(log)]  # fmt: skip
    for index in range(10, len(items) - 3, 7):
        items[index], items[index + 2] = items[index + 2], items[index]
    records = [item for item in items if isinstance(item, StepRecord)]
    in_order = iter(sorted(records, key=lambda record: record.step))
    items = [next(in_order) if isinstance(item, StepRecord) else item for item in items]
    topics = {"odom": "/odom", "instruction": "instruction"}
    found = replay(GoTo(), items, topics)
    assert (found.equal, found.note) == (True, "")


def test_missing_message_ends_it_with_a_note(log):
    items = list(read_log(log))
    gone = next(index for index, item in enumerate(items) if isinstance(item, StepRecord) and item.step == 20)
    del items[gone - 1]
    found = replay(GoTo(), items, None)
    assert found.steps == 20
    assert found.note == "a message of 'odom' that step 20 read is not in the recording"


def test_missing_record_ends_it_with_a_note(log):
    items = [item for item in read_log(log) if not (isinstance(item, StepRecord) and item.step in (5, 6))]
    found = replay(GoTo(), items, None)
    assert (found.steps, found.note) == (5, "the records of the steps 5 to 6 are not in the recording")


@pytest.mark.parametrize(
    ("keep", "words"),
    [
        (lambda item: not isinstance(item, StepRecord), "holds no step"),
        (lambda item: not (isinstance(item, StepRecord) and item.step < 3), "begins at step 3"),
    ],
)
def test_recordings_without_a_beginning(log, keep, words):
    with pytest.raises(DataError, match=words):
        replay(GoTo(), filter(keep, read_log(log)), None)


def test_full_log_keeps_its_beginning(reports, tmp_path):
    log = RunLog(tmp_path / "small", ABOUT, max_bytes=20_000)
    for report in reports:
        log(report)
    log.close()
    assert log.full
    found = replay(GoTo(), read_log(tmp_path / "small"), None)
    assert found.equal
    assert 0 < found.steps < len(reports)
    assert (tmp_path / "small").stat().st_size < 21_000


def test_run_of_a_bundle_is_not_one_of_a_controller(tmp_path):
    writer = RunWriter(tmp_path / "bundle-run")
    writer.append(Frame(FrameKind.HEADER, {"policy": "p", "seed": 1}, {}))
    writer.close()
    with pytest.raises(DataError, match="is not the log of a controller"):
        list(read_log(tmp_path / "bundle-run"))


def test_publisher_sends_what_runs_and_each_step(reports):
    exchange = Exchange()
    bus, other = MemoryBus(exchange, "vlatool_go_to"), MemoryBus(exchange, "recorder")
    publish = StepPublisher(bus, ABOUT)
    about, steps = [], []
    other.subscribe("/vlatool_go_to/controller", String, about.append, QoS(latched=True))
    other.subscribe("/vlatool_go_to/steps", String, steps.append, QoS())
    for report in reports[:5]:
        publish(report)
    assert ControllerRecord.from_json(about[0].message.data) == ABOUT
    assert [StepRecord.from_json(got.message.data) for got in steps] == [StepRecord.of(r) for r in reports[:5]]


def test_background_goes_on_when_an_observer_fails(reports):
    seen = []

    def fails(report):
        raise OSError("No space left on device")

    background = Background(fails)
    background.observe(seen.append)
    for report in reports[:10]:
        background(report)
    background.close()
    assert (len(seen), str(background.failure)) == (10, "No space left on device")


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", "null", '{"step": 1}', '{"step": true, "time_s": 0}', '{"step": 1, "time_s": 0, "x": 1}',
             '{"step": 1, "time_s": 0, "readings": [1]}', '{"step": 1, "time_s": 0, "stamp": [1]}', "[" * 5000]
)  # fmt: skip
def test_malformed_step_records(text):
    with pytest.raises(DataError, match="record"):
        StepRecord.from_json(text)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"controller": 1}', '{"controller": "a", "x": 1}'])
def test_malformed_controller_records(text):
    with pytest.raises(DataError, match="record"):
        ControllerRecord.from_json(text)


@pytest.mark.parametrize("text", ["", "a=b", "std_msgs/msg/Bool#12", "std_msgs/msg/Bool=zz", "std_msgs/msg/Bool=00"])
def test_malformed_messages(text):
    with pytest.raises(DataError, match="cannot be read"):
        from_text(text)


def test_texts_and_digests():
    message = Twist(Vector3(0.1, float("nan")), Vector3(-0.0))
    assert to_text(from_text(to_text(message))) == to_text(message)
    assert digest(message) != digest(Twist(Vector3(0.1, float("nan")), Vector3(0.0)))
    import numpy as np

    image = Image(height=1000, width=1000, encoding="rgb8", step=3000, data=np.zeros(3_000_000, np.uint8))
    assert to_text(image).startswith("sensor_msgs/msg/Image#")
    assert digest(image).endswith(":3000048")


def test_nan_in_notes_survives():
    record = StepRecord(0, 1.5, (1, 2), notes={"far": float("nan"), "word": "x"})
    assert json.loads(record.to_json())["notes"]["word"] == "x"
    assert StepRecord.from_json(record.to_json()).notes["far"] != 0


def test_records_of_a_newer_version_say_so():
    with pytest.raises(DataError, match=r"has 'mood', which vlatool .* does not know: a newer one wrote it"):
        StepRecord.from_json('{"step": 1, "time_s": 0, "mood": 1}')
    with pytest.raises(DataError, match=r"has 'mood', which vlatool .* does not know: 99\.0 wrote it"):
        ControllerRecord.from_json('{"controller": "vln", "version": "99.0", "mood": 1}')
