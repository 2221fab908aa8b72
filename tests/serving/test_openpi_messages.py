"""Messages with arrays: what goes in comes out, and nothing that is damaged does more than raise DataError."""

from __future__ import annotations

import tracemalloc
from typing import Any

import msgpack
import numpy as np
import pytest
from _malformed import malformed

from vlatool.errors import DataError
from vlatool.files.array_bytes import array_of, npy_array, npy_bytes
from vlatool.runtime.openpi_messages import flat, pack, unpack

OBSERVATION = {
    "image": np.arange(48, dtype=np.uint8).reshape(4, 4, 3), "state": np.float32([1, 2, 3]), "prompt": "go",
    "images": {"top": np.zeros((2, 2), np.int16)}, "step": 3, "scalar": np.float64(1.5), "flag": np.bool_(True),
    "words": np.array(["a", "bc"]), "none": None, "list": [1, 2.5, "x"],
}  # fmt: skip


def array(**changes: Any) -> bytes:
    return msgpack.packb(
        {"a": {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f4", b"shape": [2]} | {
            name.encode(): value for name, value in changes.items()}}
    )  # fmt: skip


def test_what_goes_in_comes_out():
    found = unpack(pack(OBSERVATION))
    assert list(found) == list(OBSERVATION)
    for name in ("image", "state", "words", "scalar", "flag"):
        assert np.asarray(found[name]).dtype == np.asarray(OBSERVATION[name]).dtype
        assert np.array_equal(found[name], OBSERVATION[name])
    assert flat(found)["images.top"].shape == (2, 2)
    assert (found["prompt"], found["step"], found["none"], found["list"]) == ("go", 3, None, [1, 2.5, "x"])


@pytest.mark.parametrize("frame", [
    b"", b"\xc1", msgpack.packb([1]), msgpack.packb("text"), msgpack.packb({b"a": 1}), msgpack.packb({"a": {b"b": 1}}),
    array(dtype="O"), array(dtype="|V8"), array(dtype="<c8"), array(dtype="i4,i4"), array(dtype=["<f4"]),
    array(dtype="<f4" * 50), array(shape=[3]), array(shape=[-1, -2]), array(shape=[2**62, 0]), array(shape="2"),
    array(shape=[2.0]), array(shape=[True, 2]), array(shape=[1] * 40 + [2]), array(data="text"), array(data=None),
    array(dtype="|b1", shape=[8], data=b"\x02" * 8), array(dtype="<U2", shape=[1], data=b"\xff" * 8),
    array(dtype="<f0", shape=[0], data=b""), array(dtype="<M8", shape=[1]),
    msgpack.packb({"a": {b"__ndarray__": True}}), msgpack.packb({"a": {b"__npgeneric__": True}}),
    msgpack.packb({"a": {b"__npgeneric__": True, b"data": "x", b"dtype": "<f4"}}),
    msgpack.packb({"a": {b"__npgeneric__": True, b"data": 300, b"dtype": "|i1"}}),
    msgpack.packb({"a": {b"__npgeneric__": True, b"data": 1, b"dtype": "O"}}),
    msgpack.packb({"a": msgpack.ExtType(5, b"x")}), msgpack.packb({"a": msgpack.Timestamp(1)}),
    msgpack.packb({"a": [0] * 20_000}), b"\x81\xa1a" + b"\x91" * 5000, b"\x81\xa1a" + b"\xdd\xff\xff\xff\xff" * 900,
    msgpack.packb({1: 2}), b"\x81\xa1a\xc6\xff\xff\xff\xff", b"\x81\xa1\xff\x00", "text", None,
])  # fmt: skip
def test_a_message_that_is_none_is_refused(frame: Any):
    with pytest.raises(DataError):
        unpack(frame)


def test_large_claims_allocate_nothing():
    frames = [b"\x81\xa1a" + b"\xdc\x3f\xff" * 1000, array(shape=[2**30, 2**9]), array(dtype="<U999999999")]
    tracemalloc.start()
    try:
        for frame in frames:
            with pytest.raises(DataError):
                unpack(frame)
        assert tracemalloc.get_traced_memory()[1] < 300e6
    finally:
        tracemalloc.stop()


def test_a_message_beyond_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "message_bytes=100")
    with pytest.raises(DataError, match="message_bytes"):
        unpack(bytes(101))


def test_damaged_messages_raise_data_errors_alone():
    refused = 0
    for frame in malformed([pack(OBSERVATION), array()], 3000):
        try:
            flat(unpack(frame))
        except DataError:
            refused += 1
    assert refused > 1000


def test_what_cannot_be_sent_is_refused():
    for wrong in (object(), np.array([None]), np.complex64(1), {1, 2}, 2**80):
        with pytest.raises(DataError, match="cannot be sent"):
            pack({"a": wrong})
    with pytest.raises(DataError, match="mappings in each other"):
        flat({"a": {"b": {"c": {"d": {"e": 1}}}}})


@pytest.mark.parametrize("value", [
    np.zeros((0, 3), np.float32), np.arange(6).reshape(2, 3), np.float32(2), np.array("x"),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.arange(3, dtype=">i4"),
])  # fmt: skip
def test_arrays_come_back_from_npy(value: Any):
    found = npy_array(npy_bytes(np.asarray(value)))
    assert found.dtype == np.asarray(value).dtype.newbyteorder("=")
    assert np.array_equal(found, value)


@pytest.mark.parametrize("content", [
    b"", b"\x93NUMPY", "text", None, npy_bytes(np.zeros(3)) + b"x", npy_bytes(np.zeros(3))[:-1],
    npy_bytes(np.zeros(3, [("a", "f4")])), npy_bytes(np.zeros(3)).replace(b"(3,)", b"(9,)"),
])  # fmt: skip
def test_bytes_that_are_no_npy_are_refused(content: Any):
    with pytest.raises(DataError):
        npy_array(content)


def test_an_array_shares_the_memory_of_its_bytes():
    data = bytes(range(16))
    assert np.shares_memory(array_of("<f4", (4,), data), np.frombuffer(data, np.uint8))
    with pytest.raises(DataError):
        array_of("<f4", b"\x04", data)
