"""Pickles are read without unpickling: plain data comes out, everything else is refused by name, and nothing runs."""

from __future__ import annotations

import builtins
import os
import pickle  # noqa: TID251 - what clients and attackers do
import struct
import subprocess
import time
import tracemalloc
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from _lerobot import RemotePolicyConfig, TimedAction, TimedObservation, pickled, unpickled, with_modules
from _malformed import malformed

from vlatool.errors import DataError
from vlatool.serving import _pickle_reader
from vlatool.serving._lerobot_data import MAKERS, read_observation, read_setup, write_actions

VALUES = {
    "shoulder.pos": 1.5,
    "step": 3,
    "large": 2**40,
    "negative": -7,
    "flag": True,
    "none": None,
    "task": "pick the cube é",
    "front": np.arange(48, dtype=np.uint8).reshape(4, 4, 3),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "transposed": np.arange(6, dtype=np.int16).reshape(2, 3).T,
    "scalar": np.float32(2.5),
    "big": np.arange(3, dtype=">f4"),
    "empty": np.zeros((0, 3), np.float32),
    "zero": np.zeros((), np.int64),
    "list": [1, [2.0, "x"], (3,)],
    "bool": np.array([True]),
    "words": np.array(["a", "bc"]),
    "bytes": b"abc",
}


@pytest.fixture(autouse=True)
def _modules() -> Iterator[None]:
    yield from with_modules()


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plain_data_comes_out_as_it_went_in(protocol: int):
    values = {
        name: value
        for name, value in VALUES.items()
        if protocol > 2 or not isinstance(value, bytes | np.ndarray | np.generic)
    }
    found = read_observation(pickled(TimedObservation(1.25, 7, values, True), protocol))
    assert (found.timestamp, found.timestep, found.must_go) == (1.25, 7, True)
    for name, value in values.items():
        got = found.observation[name]
        if isinstance(value, np.ndarray | np.generic):
            assert got.dtype == value.dtype.newbyteorder("=")
            assert np.array_equal(got, value)
        else:
            assert (got, type(got)) == (value, type(value))


@pytest.mark.parametrize("tensor", [
    torch.arange(6.0), torch.arange(6).reshape(2, 3), torch.arange(12.0).reshape(3, 4).T, torch.arange(12.0)[2:8:2],
    torch.zeros(2, 0), torch.tensor(3.5), torch.ones(3, dtype=torch.float16), torch.tensor([True, False]),
    torch.zeros((2, 2), dtype=torch.uint8), torch.ones(1).expand(1),
])  # fmt: skip
def test_tensors_come_out_as_arrays(tensor: torch.Tensor):
    found = read_observation(pickled(TimedObservation(0.0, 0, {"t": tensor})))
    assert found.observation["t"].dtype == tensor.numpy().dtype
    assert np.array_equal(found.observation["t"], tensor.numpy())


def test_instructions_come_out():
    features = {"observation.state": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]}}
    setup = read_setup(pickled(RemotePolicyConfig("act", "user/model", features, 50, "cuda", {"front": "top"})))
    assert (setup.features, setup.actions, setup.renames) == (features, 50, {"front": "top"})
    for wrong in (RemotePolicyConfig("act", "", [], 5), RemotePolicyConfig("act", "", {}, 0),  # type: ignore[arg-type]
                  RemotePolicyConfig("act", "", {}, True), RemotePolicyConfig("act", "", {}, 5, "cpu", {"a": 1})):  # type: ignore[dict-item]  # fmt: skip
        with pytest.raises(DataError):
            read_setup(pickled(wrong))


def test_actions_are_what_the_client_unpickles():
    chunk = np.float32([[0.1, -2], [3, 4]])
    actions = unpickled(write_actions(TimedAction.__module__, 10.0, 5, 0.02, chunk))
    assert [(type(each), each.timestamp, each.timestep) for each in actions] == [
        (TimedAction, 10.0, 5),
        (TimedAction, 10.02, 6),
    ]
    assert all(each.action.dtype == torch.float32 for each in actions)
    assert np.array_equal(torch.stack([each.action for each in actions]).numpy(), chunk)
    indices = unpickled(write_actions(TimedAction.__module__, 0.0, 0, 0.1, np.array([3, 1])))
    assert [each.action.tolist() for each in indices] == [[3], [1]]


class Call:
    """Pickles as a call."""

    def __init__(self, function: Any, *arguments: Any, state: Any = None) -> None:
        self.reduced = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self) -> Any:
        return self.reduced


class Extended:
    """Pickles with keyword arguments: NEWOBJ_EX."""

    def __reduce_ex__(self, protocol: Any) -> Any:
        import copyreg

        return copyreg.__newobj_ex__, (TimedObservation, (), {"timestamp": 1.0}), None


def attacks(target: Path) -> dict[str, bytes]:
    """Name -> a pickle that creates a file, or that would do so, or takes the memory, where it is unpickled."""
    touch = f"touch {target}"
    wrapped = {
        "os.system": Call(os.system, touch),
        "subprocess.Popen": Call(subprocess.Popen, ["touch", str(target)]),
        "eval": Call(builtins.eval, f"open({str(target)!r}, 'w')"),
        "exec": Call(builtins.exec, "pass"),
        "open": Call(builtins.open, str(target), "w"),
        "getattr": Call(builtins.getattr, Call(__import__, "os"), "system"),
        "a call with a state": Call(OrderedDict, state={"x": Call(os.system, touch)}),
        "list items": Call(list, (1,)),
        "NEWOBJ_EX": Extended(),
        "bytearray": Call(bytearray, 10**12),
        "numpy.load": Call(np.load, str(target)),
        "torch.load": Call(torch.load, str(target)),
        "np.ndarray": Call(np.ndarray, (10**12,)),
        "a class": Call(TimedObservation, 1.0, 2, {}),
    }
    system = f"cposix\nsystem\n(X{struct.pack('<I', len(touch)).decode('latin-1')}{touch}tR".encode("latin-1")
    raw = {
        "INST": f"(S'{touch}'\niposix\nsystem\n.",
        "OBJ": f"(cposix\nsystem\nS'{touch}'\no.",
        "STRING": "S'x'\n.",
        "PERSID": "Pos.system\n.",
        "dotted": "\x80\x04\x8c\x08builtins\x8c\x0deval.__call__\x93.",
        "EXT1": "\x80\x02\x82\x01.",
        "EXT4": "\x80\x02\x84\xff\xff\xff\x7f.",
        "LONG4": "\x80\x02\x8b\xff\xff\xff\x7f",
        "BINPERSID": "\x80\x02N\x51.",
        "memo": "\x80\x04N" + "r\xff\xff\xff\x7f" + "0j\xff\xff\xff\x7f.",
        "DUP": "\x80\x04]2a.",
        "POP": "\x80\x04N0N.",
        "frame": "\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7fN.",
        "bytes": "\x80\x04\x8e\xff\xff\xff\xff\xff\x00\x00\x00",
        "bytearray8": "\x80\x05\x96\xff\xff\xff\xff\xff\xff\xff\x7f",
        "text": "\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7f",
        "buffer": "\x80\x05\x97.",
        "no mark": "\x80\x04t.",
        "empty": "",
        "stop": ".",
        "mark": "\x80\x04(.",
        "protocol": "\x80\x09N.",
        "attribute of a name": "\x80\x04cnumpy\ndtype\n}X\x04\x00\x00\x00nameK\x01sb.",
        "called data": "\x80\x04N)R.",
        "frozen": "\x80\x04\x8f.",
        "set": "\x80\x04\x8f(N\x90.",
        "cycle": "\x80\x04]\x94h\x00a.",
        "cycle of tuples": "\x80\x04]\x94h\x00\x85a.",
        "unhashable": "\x80\x04}]Ns.",
        "negative": "\x80\x04cnumpy\ndtype\n\x8c\x03f-4\x89\x88\x87R.",
        "name": "\x80\x04cnumpy\ndtype\n.",
    }
    laughs = "\x80\x04]\x94" + "".join(f"]\x94(h{chr(level)}h{chr(level)}e" for level in range(30)) + "."
    return {
        **{name: pickled(value) for name, value in wrapped.items()},
        **{
            f"{name}, within an observation": pickled(TimedObservation(0.0, 0, {"x": [value]}))
            for name, value in wrapped.items()
        },
        **{f"{name}, as a state": pickled(Call(OrderedDict, state={"y": value})) for name, value in wrapped.items()},
        **{f"{name} (protocol 0)": pickled(value, 0) for name, value in wrapped.items() if name != "NEWOBJ_EX"},
        **{name: text.encode("latin-1") for name, text in raw.items()},
        "laughs": laughs.encode("latin-1"),
        "system": b"\x80\x02" + system + b".",
        "dropped": b"\x80\x02" + system + b"0N.",
        "behind the end": pickled(5) + b"\x80\x02" + system + b".",
        "before the end": pickled(TimedObservation(0.0, 0, {}))[:-1] + system + b"0.",
        "in a tensor": tensor_with(b"\x80\x02" + system + b"."),
        "deep": b"\x80\x04" + b"]" * 100_000 + b"a" * 99_999 + b".",
        "many": b"\x80\x04" + b"N" * 300_000 + b".",
    }


def tensor_with(stored: bytes) -> bytes:
    """A tensor whose storage is another pickle."""

    class Storage:
        def __reduce__(self) -> Any:
            return torch.storage._load_from_bytes, (stored,)

    class Tensor:
        def __reduce__(self) -> Any:
            return torch._utils._rebuild_tensor_v2, (Storage(), 0, (1,), (1,), False, OrderedDict())

    return pickled(TimedObservation(0.0, 0, {"t": Tensor()}))


def test_nothing_that_a_pickle_asks_for_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    target = tmp_path / "harm"
    frames = attacks(target)
    unpickled(frames["os.system"])  # it would run
    assert target.exists()
    target.unlink()
    imported: list[str] = []
    monkeypatch.setattr(
        builtins, "__import__", lambda *given, **more: imported.append(given[0]) or __import__(*given, **more)
    )
    for name, frame in frames.items():
        for read in (read_observation, read_setup):
            began = time.monotonic()
            with pytest.raises(DataError):
                read(frame)
            assert time.monotonic() - began < 5, name
    assert not {"posix", "os", "subprocess", "builtins", "numpy"}.intersection(imported)
    assert not target.exists()


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (pickle.dumps(Call(os.system, "true")), "posix.system"),
        (pickle.dumps(Call(eval, "1")), "builtins.eval"),
        (b"(S'true'\niposix\nsystem\n.", "opcode STRING"),
        (b"(iposix\nsystem\n.", "opcode INST"),
        (b"\x80\x02NQ.", "persistent id"),
        (b"\x80\x04\xff.", "0xff"),
        (pickle.dumps(5), "allowed: a TimedObservation"),
        (pickle.dumps(5) + b"x", "follow"),
    ],
)
def test_what_is_refused_is_named(frame: bytes, message: str):
    with pytest.raises(DataError, match=message):
        read_observation(frame)


def test_large_claims_allocate_little(tmp_path: Path):
    frames = attacks(tmp_path / "harm")
    tracemalloc.start()
    try:
        for name in ("memo", "bytes", "bytearray8", "text", "frame", "laughs", "bytearray", "np.ndarray", "LONG4"):
            with pytest.raises(DataError):
                read_observation(frames[name])
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("shape", "stride", "offset"),
    [
        ((4,), (1,), 0),
        ((2,), (2,), 2),
        ((3,), (1,), 1),
        ((2**39,), (0,), 0),
        ((-1,), (1,), 0),
        ((1,), (-1,), 2),
        ((1,), (1, 1), 0),
        ((2, 2), (2, 1), 0),
        ((1,) * 40, (1,) * 40, 0),
        ((1,), (1,), 2**50),
        ((1.0,), (1,), 0),
    ],
)
def test_a_tensor_beyond_its_storage_is_refused(shape: Any, stride: Any, offset: Any):
    storage = torch.arange(3.0).untyped_storage()

    class Tensor:
        def __reduce__(self) -> Any:
            typed = torch.storage.TypedStorage(wrap_storage=storage, dtype=torch.float32, _internal=True)
            return torch._utils._rebuild_tensor_v2, (typed, offset, shape, stride, False, OrderedDict())

    with pytest.raises(DataError):
        read_observation(pickled(TimedObservation(0.0, 0, {"t": Tensor()})))


def test_damaged_pickles_raise_data_errors_alone():
    frames = [
        pickled(TimedObservation(1.0, 2, dict(VALUES), True)),
        pickled(TimedObservation(1.0, 2, {"t": torch.arange(3.0)})),
        pickled(RemotePolicyConfig("act", "x", {"a": {"names": ["b"]}}, 5)),
    ]
    refused = 0
    for frame in malformed(frames, 1500, seed=3):
        for read in (read_observation, read_setup):
            try:
                read(frame)
            except DataError:
                refused += 1
    assert refused > 1500


def test_the_allow_list_names_no_function_that_reads_files_or_runs_code():
    assert {name.partition(".")[0] for name in MAKERS} == {"lerobot", "numpy", "torch", "collections"}
    source = Path(_pickle_reader.__file__).read_text() + Path(write_actions.__code__.co_filename).read_text()
    for word in ("import pickle\n", "find_class", "importlib", "getattr(", "eval(", "exec("):
        assert word not in source
