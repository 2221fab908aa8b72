"""The small form of ``messages_fuzz.py``: malformed bytes of every type, and memory that the bytes bound."""

from __future__ import annotations

import struct
import tracemalloc

import pytest
from _full import small_or_full
from messages_fuzz import run

from vlatool.errors import BusError
from vlatool.messages import Message, all_types, cdr, ros1


def test_malformed_bytes_are_refused_or_are_a_message() -> None:
    outcomes = run(small_or_full(5_000, 200_000), 1)
    assert outcomes["refused"] > outcomes["accepted"] > 0
    assert not outcomes["crashed"]


@pytest.mark.parametrize("codec", [cdr, ros1], ids=["cdr", "ros1"])
@pytest.mark.parametrize("length", [2**31 - 1, 2**31, 2**32 - 1, 100_000, 1])
def test_memory_is_bounded_by_the_bytes(codec: type[cdr], length: int) -> None:
    """Each length is checked against the bytes that are left: 100 kB of any one number never take 10 MB."""
    encoded = (b"\0\1\0\0" if codec is cdr else b"") + struct.pack("<I", length) * 25_000
    for cls in all_types():
        tracemalloc.start()
        try:
            assert isinstance(codec.decode(cls, encoded), Message)
        except BusError:
            pass
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert peak < 10_000_000, cls.TYPE
