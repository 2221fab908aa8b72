"""Messages in CDR and in ROS 1's encoding: the bytes of rosbags, and back to the same message."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
from _full import small_or_full
from _messages import Drawer, as_rosbags, in_ros1, ros1_store, ros2_store, without_absent

from vlatool.errors import BusError
from vlatool.messages import Message, all_types, cdr, ros1, same
from vlatool.messages._members import members
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Point, Twist, Vector3
from vlatool.messages.sensor_msgs import CameraInfo, Image, JointState, LaserScan, PointCloud2, PointField
from vlatool.messages.std_msgs import Header, String
from vlatool.messages.std_srvs import TriggerRequest
from vlatool.messages.tf2_msgs import TFMessage
from vlatool.messages.visualization_msgs import Marker, MeshFile

JAZZY, NOETIC = ros2_store(), ros1_store()
DRAWS = small_or_full(200, 10_000)
SHARED = [cls for cls in all_types() if in_ros1(cls)]


@pytest.mark.parametrize("cls", all_types(), ids=lambda cls: cls.TYPE)
def test_cdr_is_that_of_rosbags(cls: type[Message]) -> None:
    drawer = Drawer(1)
    for _ in range(DRAWS):
        message = drawer.message(cls)
        encoded, other = cdr.encode(message), as_rosbags(message, JAZZY)
        assert encoded == JAZZY.serialize_cdr(other, cls.TYPE)
        assert same(cdr.decode(cls, encoded), message)
        assert same(cdr.decode(cls, JAZZY.serialize_cdr(other, cls.TYPE, little_endian=False)), message)


@pytest.mark.parametrize("cls", SHARED, ids=lambda cls: cls.TYPE)
def test_ros1_is_that_of_rosbags(cls: type[Message]) -> None:
    drawer = Drawer(2)
    for _ in range(DRAWS):
        message = drawer.message(cls)
        encoded = ros1.encode(message)
        assert encoded == NOETIC.serialize_ros1(as_rosbags(message, NOETIC, ros1=True), cls.TYPE)
        assert same(ros1.decode(cls, encoded), without_absent(message))


WRONG = [
    (Twist(linear=Vector3(x="fast")), "geometry_msgs/msg/Twist: linear.x is 'fast' (str), not a number"),
    (Twist(linear=Point()), "linear is of type Point, not a geometry_msgs/msg/Vector3"),
    (Twist(linear=None), "linear is None, not a geometry_msgs/msg/Vector3"),
    (LaserScan(angle_min=1e39), "angle_min is 1e+39 (float), beyond the range of float32"),
    (LaserScan(angle_min=np.zeros(2)), "angle_min is of type ndarray, not a number"),
    (Image(height=-1), "height is -1 (int), out of the range of uint32"),
    (Image(width=2**32), "width is 4294967296 (int), out of the range of uint32"),
    (Image(width=2.0), "width is 2.0 (float), not an integer"),
    (Image(encoding=b"rgb8"), "encoding is of type bytes, not a string"),
    (Image(encoding="\ud800"), "encoding is '\\ud800' (str), which UTF-8 cannot express"),
    (Image(data=[1, 2]), "data is of type list, not a one-dimensional array of uint8"),
    (Image(data=np.zeros((2, 2), np.uint8)), "data is an array (2, 2) of uint8, not a one-dimensional array"),
    (Image(data=np.zeros(2, np.int64)), "data is an array (2,) of int64, not a one-dimensional array of uint8"),
    (LaserScan(ranges=np.zeros(2)), "ranges is an array (2,) of float64, not a one-dimensional array of float32"),
    (CameraInfo(k=np.zeros(8)), "k is an array (8,) of float64, not a one-dimensional array of 9 of float64"),
    (PointCloud2(is_dense=1), "is_dense is 1 (int), not a truth value"),
    (PointCloud2(is_dense="no"), "is_dense is 'no' (str), not a truth value"),
    (PointCloud2(fields=(PointField(), PointField(datatype=256))), "fields[1].datatype is 256 (int), out of the range"),
    (PointCloud2(fields=("x",)), "fields[0] is 'x' (str), not a sensor_msgs/msg/PointField"),
    (PointCloud2(fields=PointField()), "fields is of type PointField, not a tuple"),
    (JointState(name=("a", 2)), "name[1] is 2 (int), not a string"),
    (JointState(name="abc"), "name is 'abc' (str), not a tuple"),
    (Image(header=Header(stamp=Time(0, -1))), "header.stamp.nanosec is -1 (int), out of the range of uint32"),
    ("text", "str is not a type of message"),
]  # fmt: skip


@pytest.mark.parametrize("codec", [cdr, ros1], ids=["cdr", "ros1"])
@pytest.mark.parametrize(("message", "problem"), WRONG, ids=range(len(WRONG)))
def test_wrong_value_is_named(codec: ModuleType, message: Message, problem: str) -> None:
    with pytest.raises(BusError) as caught:
        codec.encode(message)
    assert problem in caught.value.message
    assert caught.value.fix
    with pytest.raises(BusError):
        codec.encode_parts(message)


class Troublesome:
    """A value that fails when it is read as a number or as an integer."""

    def __float__(self) -> float:
        raise ValueError("not now")

    __index__ = __float__


ODD = (
    None, "x", b"x", -1, 2**70, 1.5, float("nan"), True, (), [], (1,), ["a", 2], ("a", "\ud800"), {}, object(), 1j,
    Twist, Twist(), PointField(), Troublesome(), np.zeros(3), np.zeros((3, 3)), np.zeros(9, np.float32), np.zeros(36),
    np.zeros(4, np.uint8), np.zeros(3, object), np.array(["a"]), np.float32(2.0), np.array(3.0), np.zeros(12)[::2],
)  # fmt: skip


@pytest.mark.parametrize("codec", [cdr, ros1], ids=["cdr", "ros1"])
def test_any_value_is_encoded_or_named(codec: ModuleType) -> None:
    """Each odd value in each field of each type: its bytes are read again, or the error names the field."""
    refused = unnamed = 0
    for cls in all_types():
        for member in members(cls):
            for value in ODD:
                message = cls(**{member.attribute: value})
                try:
                    encoded = codec.encode(message)
                except BusError as error:
                    refused += 1
                    unnamed += not error.message.startswith(f"{cls.TYPE}: {member.attribute}") or not error.fix
                else:
                    codec.decode(cls, encoded)
    assert refused > 2000
    assert not unnamed


def test_values_of_numpy_and_python_that_fit() -> None:
    """NaN and infinities, NumPy's scalars, ints as floats, bytes as uint8, float32 arrays as float64, any strides."""
    twist = Twist(Vector3(float("nan"), float("inf"), np.float32(1.5)), Vector3(1, np.int16(2), True))
    assert same(
        cdr.decode(Twist, cdr.encode(twist)), Twist(Vector3(float("nan"), float("inf"), 1.5), Vector3(1.0, 2.0, 1.0))
    )
    image = Image(height=np.uint16(1), width=np.int64(3), data=b"\1\2\3")
    assert cdr.decode(Image, cdr.encode(image)).data.tolist() == [1, 2, 3]
    cloud = cdr.decode(PointCloud2, cdr.encode(PointCloud2(is_dense=np.bool_(True), fields=[PointField("x")])))
    assert cloud.is_dense is True
    assert same(cloud.fields, (PointField("x"),))
    joints = JointState(name=["a"], position=np.arange(6, dtype=np.float32)[::2], velocity=np.arange(2.0).astype(">f8"))
    state = ros1.decode(JointState, ros1.encode(joints))
    assert (state.name, state.position.tolist(), state.velocity.tolist()) == (("a",), [0.0, 2.0, 4.0], [0.0, 1.0])


def test_large_arrays_are_not_copied() -> None:
    pixels = np.arange(240 * 320 * 3, dtype=np.uint32).astype(np.uint8)
    message = Image(Header(Time(1, 2), "camera"), 240, 320, "rgb8", 0, 960, pixels)
    for codec in (cdr, ros1):
        parts = codec.encode_parts(message)
        assert [np.shares_memory(np.frombuffer(part, np.uint8), pixels) for part in parts] == [False, True]
        encoded = codec.encode(message)
        assert b"".join(parts) == encoded
        decoded = codec.decode(Image, encoded)
        assert np.shares_memory(decoded.data, np.frombuffer(encoded, np.uint8))
        assert not codec.decode(Image, bytearray(encoded)).data.flags.writeable


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview, lambda data: np.frombuffer(data, np.uint8)])
def test_decoded_from_any_buffer(kind: Callable[[bytes], object]) -> None:
    twist = Twist(Vector3(1.0, 2.0, 3.0))
    assert same(cdr.decode(Twist, kind(cdr.encode(twist))), twist)
    assert same(ros1.decode(Twist, kind(ros1.encode(twist))), twist)


def test_empty_string_without_its_zero_byte() -> None:
    """Some implementations of DDS send an empty string as a length of 0."""
    assert cdr.decode(String, b"\0\1\0\0" + bytes(4)).data == ""


@pytest.mark.parametrize(("cls", "encoded", "problem"), [
    (Twist, b"", "0 bytes, fewer than the header of CDR has"),
    (Twist, b"\0\x07\0\0" + bytes(48), "in the encoding 0x0007, not in plain CDR"),
    (Twist, b"\0\1\0\0" + bytes(47), "at linear.x to angular.z: 48 bytes, where 47 are left"),
    (Twist, b"\0\1\0\0" + bytes(52), "52 bytes, of which it takes 48"),
    (String, b"\0\1\0\0" + b"\xff\xff\xff\x7fabc\0", "at data: a string of 2,147,483,647 bytes, where 4"),
    (String, b"\0\1\0\0" + b"\4\0\0\0" + b"abcd", "at data: a string without the zero byte at its end"),
    (String, b"\0\1\0\0" + b"\2\0\0\0" + b"\xff\0", "at data: a string that is not UTF-8"),
    (TFMessage, b"\0\1\0\0" + b"\0\0\0\x80" + bytes(64), "at transforms: 2,147,483,648 elements of at least"),
    (PointCloud2, cdr.encode(PointCloud2(data=np.zeros(64, np.uint8)))[:-9], "at data: 64 numbers of 1 bytes each"),
    (JointState, b"\0\1\0\0" + bytes(12) + b"\xff" * 4 + bytes(64), "at name: 4,294,967,295 elements of at least"),
    (JointState, b"\0\1\0\0" + bytes(16) + b"\xff" * 4, "at position: 4,294,967,295 numbers of 8 bytes each, where 0"),
])  # fmt: skip
def test_malformed_bytes_are_named(cls: type[Message], encoded: bytes, problem: str) -> None:
    with pytest.raises(BusError) as caught:
        cdr.decode(cls, encoded)
    assert problem in caught.value.message
    assert cls.TYPE in caught.value.message
    assert caught.value.fix


def test_other_things_than_bytes_are_refused() -> None:
    with pytest.raises(BusError, match="not from str"):
        cdr.decode(Twist, "text")
    with pytest.raises(BusError, match="not from ndarray"):
        ros1.decode(Twist, np.zeros((8, 12), np.uint8)[:, ::2])


def test_fields_that_ros1_lacks_are_left_out() -> None:
    marker = Marker(ns="a", texture_resource="b", mesh_file=MeshFile("c"), text="d")
    decoded = ros1.decode(Marker, ros1.encode(marker))
    assert (decoded.ns, decoded.texture_resource, decoded.mesh_file.filename, decoded.text) == ("a", "", "", "d")
    assert same(ros1.decode(TriggerRequest, ros1.encode(TriggerRequest())), TriggerRequest())
    assert (ros1.encode(TriggerRequest()), cdr.encode(TriggerRequest())) == (b"", b"\0\1\0\0\0")
