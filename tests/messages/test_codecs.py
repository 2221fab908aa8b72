"""Messages in CDR and in ROS 1's encoding: the bytes of rosbags, and back to the same message."""

from __future__ import annotations

import pytest
from _full import small_or_full
from _messages import Drawer, as_rosbags, in_ros1, ros1_store, ros2_store, without_absent

from vlatool.messages import Message, all_types, cdr, ros1, same

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
