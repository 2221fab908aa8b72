from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from vlatool.buses import Bus, QoS, Reception, open_bus
from vlatool.buses import _bag_writer as bag_writer
from vlatool.buses.bag import Bag
from vlatool.errors import BusError, MissingExtra, OutputError, UsageError
from vlatool.messages import Message, same
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.sensor_msgs import Image, JointState
from vlatool.messages.std_msgs import Bool, Header, String

NEW = ["run", "run.mcap", "run.db3", "run.bag"]
START_NS = 1_700_000_000_123_456_789
WAIT_S = 10.0


def messages() -> list[tuple[str, Message]]:
    draw = np.random.default_rng(3)
    pixels = draw.integers(0, 256, 4 * 6 * 3, np.uint8)
    image = Image(Header(Time(5, 6), "camera"), 4, 6, "rgb8", 0, 18, pixels)
    joints = JointState(Header(frame_id="ü"), ("one", "two"), draw.normal(size=2))
    return [
        ("/image", image),
        ("/joint_states", joints),
        ("/cmd_vel", Twist(Vector3(float("nan"), -0.0, 5e-324))),
        ("/joint_states", JointState()),
        ("/say", String("go")),
    ]


def write(path: Path, content: list[tuple[str, Message]] | None = None) -> Path:
    """Write a bag, a message each 0.1 s; return its path."""
    writer = bag_writer.BagWriter(path)
    for index, (topic, message) in enumerate(messages() if content is None else content):
        writer.put(topic, message, START_NS + index * 100_000_000)
    writer.close()
    return writer.path


def fields(message: Message) -> dict[str, Any]:
    return {name: getattr(message, name) for name in message.__dataclass_fields__}  # type: ignore[attr-defined]


def equal(ours: Any, theirs: Any) -> bool:
    """Compare a message with that of rosbags, field by field; rosbags has the sequence number of ROS 1, too."""
    if isinstance(ours, Message):
        return all(equal(value, getattr(theirs, name)) for name, value in fields(ours).items())
    if isinstance(ours, np.ndarray):
        return ours.tobytes() == np.asarray(theirs, ours.dtype).tobytes()
    return list(ours) == list(theirs) if isinstance(ours, tuple) else same(ours, theirs)


@pytest.mark.parametrize("name", NEW)
def test_what_is_published_is_read_by_rosbags_and_by_us(tmp_path: Path, name: str) -> None:
    bus = open_bus(f"bag::{tmp_path}/new/{name}", "vlatool_run")
    assert isinstance(bus, Bus)
    senders: dict[str, Callable[[Any], None]] = {}
    for topic, message in messages():
        if topic not in senders:
            senders[topic] = bus.publisher(topic, type(message), QoS())
        senders[topic](message)
    bus.close()
    bus.close()
    path = tmp_path / "new" / (name if name.endswith(".bag") else "run")
    first = name.endswith(".bag")
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_JAZZY)
    with (rosbag1.Reader if first else rosbag2.Reader)(path) as reader:
        digests = {each.topic: each.digest for each in reader.connections}
        found = [
            (each.topic, (store.deserialize_ros1 if first else store.deserialize_cdr)(content, each.msgtype))
            for each, _, content in reader.messages()
        ]
    twist = "9f195f881246fdfa2798d1d3eebca84a" if first else store.hash_rihs01("geometry_msgs/msg/Twist")
    assert digests["/cmd_vel"] == twist
    assert [topic for topic, _ in found] == [topic for topic, _ in messages()]
    assert all(equal(ours, theirs) for (_, ours), (_, theirs) in zip(messages(), found, strict=True))
    again = Bag(str(path), "node")
    assert all(same(one.message, other) for one, (_, other) in zip(again.messages(), messages(), strict=True))
    again.close()


@pytest.mark.parametrize("name", NEW)
def test_a_recording_is_played_in_its_order_and_times(tmp_path: Path, name: str) -> None:
    bus = Bag(f"{write(tmp_path / name)}:{tmp_path}/answers", "node")
    got: list[Reception] = []
    answer = bus.publisher("/answer", String, QoS())

    def handle(reception: Reception) -> None:
        got.append(reception)
        answer(String(f"{reception.received_s:.1f}"))

    for topic, kind in {topic: type(message) for topic, message in messages()[:4]}.items():
        bus.subscribe(topic, kind, handle, QoS())
    assert bus.duration_s == pytest.approx(0.4, abs=1e-6)
    assert bus.play() == 4
    assert bus.ended.is_set()
    assert all(same(one.message, other) for one, (_, other) in zip(got, messages()[:4], strict=True))
    assert [each.received_s for each in got] == pytest.approx([0, 0.1, 0.2, 0.3])
    bus.close()
    with rosbag2.Reader(tmp_path / "answers") as reader:
        times = [time_ns - START_NS for _, time_ns, _ in reader.messages()]
    assert times == [0, 100_000_000, 200_000_000, 300_000_000]


def test_a_recording_plays_in_real_time_once_somebody_listens(tmp_path: Path) -> None:
    content: list[tuple[str, Message]] = [("/say", String(str(index))) for index in range(3)]
    bus = Bag(str(write(tmp_path / "bag", content)), "node")
    got: list[tuple[Message, float]] = []
    began = threading.Event()

    def handle(reception: Reception) -> None:
        began.set()
        got.append((reception.message, bus.stamp().seconds))

    bus.subscribe("say", String, handle, QoS())
    assert not began.is_set()
    assert bus.wait_for_peers(("/say", "/scan"), 0.0) == ("/scan",)
    assert not began.is_set()
    assert bus.wait_for_peers(("say",), 0.0) == ()
    assert bus.ended.wait(WAIT_S)
    bus.close()
    assert [each.data for each, _ in got if isinstance(each, String)] == ["0", "1", "2"]
    assert all(stamp >= START_NS / 1e9 + 0.1 * index - 1e-3 for index, (_, stamp) in enumerate(got))


def test_topics_are_those_of_the_recording_and_our_own(tmp_path: Path) -> None:
    bus = Bag(f"{write(tmp_path / 'bag')}:{tmp_path}/new", "node")
    bus.publisher("/cmd_vel", Twist, QoS())
    bus.publisher("~state", String, QoS())
    bus.subscribe("/image", Image, lambda each: None, QoS())
    found = {info.topic: (info.types[0].split("/")[-1], info.publishers, info.subscribers) for info in bus.topics()}
    assert found == {
        "/cmd_vel": ("Twist", ("node",), ()),
        "/image": ("Image", (), ("node",)),
        "/joint_states": ("JointState", (), ()),
        "/node/state": ("String", ("node",), ()),
        "/say": ("String", (), ()),
    }
    bus.close()


def test_another_type_is_refused_with_both_names(tmp_path: Path) -> None:
    bus = Bag(str(write(tmp_path / "bag")), "node")
    with pytest.raises(BusError, match="/cmd_vel carries geometry_msgs/msg/Twist, not std_msgs/msg/Bool"):
        bus.subscribe("cmd_vel", Bool, lambda each: None, QoS())
    with pytest.raises(BusError, match="/cmd_vel carries geometry_msgs/msg/Twist, not std_msgs/msg/Bool"):
        bus.publisher("/cmd_vel", Bool, QoS())
    send = bus.publisher("/new", Bool, QoS())
    with pytest.raises(BusError, match="/new carries std_msgs/msg/Bool, not std_msgs/msg/String"):
        bus.publisher("/new", String, QoS())
    with pytest.raises(BusError, match="not a String"):
        send(String())  # type: ignore[arg-type]
    send(Bool())
    with pytest.raises(BusError, match="a bag holds topics alone"):
        bus.call("/set", Bool(), Bool, 1.0)
    bus.serve("/set", Bool, Bool, lambda request: Bool())
    bus.close()
    with pytest.raises(BusError, match="left the bus"):
        send(Bool())


@pytest.mark.parametrize("name", NEW)
def test_an_output_that_exists_is_refused(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name)
    with pytest.raises(OutputError, match=r"exists already(?s:.*)nothing is replaced") as caught:
        Bag(f"{path}:{tmp_path / name}", "node")
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("address", ["", ":", "a:b:c"])
def test_an_address_without_a_bag_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="names no bag"):
        Bag(address, "node")


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BusError, match="There is no bag"):
        Bag(str(tmp_path / "none.mcap"), "node")
    (tmp_path / "note.txt").write_text("hello")
    with pytest.raises(BusError, match=r"note.txt is not a bag: its name ends in none of .bag, .mcap, .db3"):
        Bag(str(tmp_path / "note.txt"), "node")
    for name in ("junk.bag", "junk.mcap", "junk.db3", "junk"):
        path = tmp_path / name
        path.write_bytes(b"\x00junk" * 999) if path.suffix else path.mkdir()
        with pytest.raises(BusError, match="cannot be read"):
            Bag(str(path), "node")


def test_an_absent_library_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag2", None)
    with pytest.raises(MissingExtra, match=r"rosbags.*bags"):
        Bag(f":{tmp_path}/new", "node")


def test_a_type_that_is_unknown_or_defined_otherwise_is_refused(tmp_path: Path) -> None:
    with rosbag2.Writer(tmp_path / "bag", version=8, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        path = writer.add_connection("/path", "nav_msgs/msg/Path", typestore=store)
        writer.write(path, 1, b"\x00\x01\x00\x00")
        other = writer.add_connection("/odd", Twist.TYPE, msgdef="float32 x\n", rihs01="RIHS01_" + "0" * 64)
        writer.write(other, 2, b"\x00\x01\x00\x00")
        short = writer.add_connection("/short", Twist.TYPE, typestore=store)
        writer.write(short, 3, b"\x00\x01\x00\x00\x01\x02")
    bus = Bag(str(tmp_path / "bag"), "node")
    with pytest.raises(BusError, match="carries nav_msgs/msg/Path"):
        bus.subscribe("/path", Twist, lambda each: None, QoS())
    with pytest.raises(BusError, match=r"/path.* nav_msgs/msg/Path, which vlatool lacks"):
        next(bus.messages(["/path"]))
    with pytest.raises(BusError, match="geometry_msgs/msg/Twist is defined otherwise"):
        bus.subscribe("/odd", Twist, lambda each: None, QoS())
    bus.subscribe("/short", Twist, lambda each: None, QoS())
    with pytest.raises(BusError, match=r"A message of /short in .* is malformed"):
        bus.play()
    bus.wait_for_peers((), 0.0)
    assert bus.ended.wait(WAIT_S)
    with pytest.raises(BusError, match="malformed"):
        bus.close()


def test_a_full_disk_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bag(f":{tmp_path}/new", "node")

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(rosbag2.Writer, "write", fail)
    bus.publisher("/say", String, QoS())(String())
    with pytest.raises(OutputError, match=r"new cannot be written: .*No space left(?s:.*)free space"):
        bus.close()


def test_messages_that_the_disk_does_not_take_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_writer, "MAX_WAITING_BYTES", 60)
    go_on, entered = threading.Event(), threading.Event()
    write_one = rosbag2.Writer.write

    def slow(*arguments: Any) -> None:
        entered.set()
        assert go_on.wait(WAIT_S)
        write_one(*arguments)

    monkeypatch.setattr(rosbag2.Writer, "write", slow)
    bus = Bag(f":{tmp_path}/new", "node")
    send = bus.publisher("/cmd_vel", Twist, QoS())
    send(Twist())
    assert entered.wait(WAIT_S)
    for _ in range(5):
        send(Twist())
    go_on.set()
    with pytest.raises(BusError, match="4 messages are not in"):
        bus.close()
    again = Bag(str(tmp_path / "new"), "node")
    assert len(list(again.messages())) == 2
    again.close()


def test_bag_that_rosbag_record_has_not_finished_is_named(tmp_path):
    (tmp_path / "run.bag.active").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(
        BusError, match=r"run\.bag\.active has no index yet(?s:.*)rosbag reindex .*, then mv .*run\.bag$"
    ):
        open_bus(f"bag:{tmp_path / 'run.bag.active'}", "node")
