"""What LeRobot's client and server send each other as pickles, read and written without pickle.

The names on the allow-list are those that its client writes: three dataclasses, arrays, scalars and dtypes of NumPy,
tensors of torch (as ``torch.save`` wrote storages before its zip format, which their pickles still have), and the
description of a feature.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError
from vlatool.files.array_bytes import array_of
from vlatool.serving._pickle_reader import FIX, PERSISTENT, Maker, Name, read_first_pickle, read_pickle

Array = NDArray[Any]
MODULES = ("lerobot.async_inference.helpers", "lerobot.scripts.server.helpers")
"""Modules of the dataclasses: since LeRobot 0.4, and before."""
STORAGES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8", "IntStorage": "<i4",
    "ShortStorage": "<i2", "CharStorage": "|i1", "ByteStorage": "|u1", "BoolStorage": "|b1",
}  # fmt: skip
TORCH_MAGIC = 0x1950A86A20F9469CFC6C
TORCH_PROTOCOL = 1001
MAX_AXES = 16


@dataclass(frozen=True)
class PolicySetup:
    """What a client expects of the policy.

    Args:
        module: Module of the client's classes.
        features: Name -> dtype, shape and names of the elements of what an observation is made of.
        actions: Number of actions in a chunk that the client takes.
        renames: Name of the client -> name of the policy.
    """

    module: str
    features: Mapping[str, Any]
    actions: int
    renames: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class TimedObservation:
    """What a client sees.

    Args:
        timestamp: Time of the client's clock in seconds.
        timestep: Number of the control step.
        observation: Name -> value.
        must_go: Whether it has to be answered.
    """

    timestamp: float
    timestep: int
    observation: Mapping[str, Any]
    must_go: bool = False


def read_setup(data: bytes) -> PolicySetup:
    """Return what a ``RemotePolicyConfig`` says; raises DataError for anything else."""
    module, values = _object(data, "RemotePolicyConfig")
    features, actions, renames = (values.get(key) for key in ("lerobot_features", "actions_per_chunk", "rename_map"))
    if not isinstance(features, dict) or type(actions) is not int or actions < 1:
        raise DataError("The policy instructions lack features or a number of actions.", FIX)
    renames = {} if renames is None else renames
    if not isinstance(renames, dict) or not all(isinstance(name, str) for name in renames.values()):
        raise DataError("The rename_map of the policy instructions is not a mapping of names.", FIX)
    return PolicySetup(module, features, actions, renames)


def read_observation(data: bytes) -> TimedObservation:
    """Return what a ``TimedObservation`` says; raises DataError for anything else."""
    _, values = _object(data, "TimedObservation")
    timestamp, timestep, observation = (values.get(key) for key in ("timestamp", "timestep", "observation"))
    if not isinstance(timestamp, int | float) or not abs(timestamp) < 1e15:
        raise DataError("The observation lacks its time.", FIX)
    if type(timestep) is not int or not 0 <= timestep < 1 << 53 or not isinstance(observation, dict):
        raise DataError("The observation lacks its step or its values.", FIX)
    return TimedObservation(float(timestamp), timestep, observation, values.get("must_go") is True)


def _object(data: bytes, name: str) -> tuple[str, dict[str, Any]]:
    """Return module and attributes of the object of one class that a pickle holds."""
    value = read_pickle(data, MAKERS)
    if not isinstance(value, _Object) or value.name != name:
        got = value.name if isinstance(value, _Object) else type(value).__name__
        raise DataError(f"The message is a {got}; allowed: a {name}.", FIX)
    return value.module, value.attributes


@dataclass(frozen=True)
class _Object:
    """An object of one of LeRobot's dataclasses."""

    module: str
    name: str
    attributes: dict[str, Any]


def _dataclass(module: str, name: str) -> Maker:
    def make(arguments: tuple[Any, ...], state: Any) -> _Object:
        if arguments or not isinstance(state, dict):
            raise DataError(f"The pickle has a {name} without attributes.", FIX)
        return _Object(module, name, state)

    return make


def _feature(arguments: tuple[Any, ...], state: Any) -> dict[str, Any]:
    """Return a PolicyFeature as a mapping."""
    if arguments or not isinstance(state, dict):
        raise TypeError("a feature has no attributes")
    return state


def _first(arguments: tuple[Any, ...], state: Any) -> Any:
    """Return the value of a member of an enumeration."""
    (value,) = arguments
    return value


def _dtype(arguments: tuple[Any, ...], state: Any) -> _Dtype:
    order = state[1] if isinstance(state, tuple) else "="
    if not isinstance(arguments[0], str) or order not in ("<", ">", "=", "|"):
        raise TypeError("it has an unknown dtype")
    return _Dtype(order + arguments[0])


class _Dtype(str):
    """A dtype as NumPy writes it."""


def _array(arguments: tuple[Any, ...], state: Any) -> Array:
    """Return what ``_reconstruct`` and its state say."""
    _, shape, dtype, fortran, data = state
    if not isinstance(dtype, _Dtype) or not isinstance(shape, tuple):
        raise TypeError("it has no array")
    array = array_of(str(dtype), shape[::-1] if fortran is True else shape, data)
    return array.T if fortran is True else array


def _from_buffer(arguments: tuple[Any, ...], state: Any) -> Array:
    """Return what ``_frombuffer`` says, of NumPy with protocol 5."""
    data, dtype, shape, order = arguments[:4]
    return _array((), (1, shape, dtype, order == "F", data))


def _scalar(arguments: tuple[Any, ...], state: Any) -> Any:
    dtype, data = arguments
    return _array((), (1, (), dtype, False, data))[()]


def _nothing(arguments: tuple[Any, ...], state: Any) -> dict[str, Any]:
    """Return no hooks; raises TypeError for some."""
    if arguments or state:
        raise TypeError("it has hooks")
    return {}


def _storage(arguments: tuple[Any, ...], state: Any) -> Array:
    """Return the elements of a storage, (N,), from what ``torch.save`` writes without zip."""
    (content,) = arguments
    values, at = [], 0
    for _ in range(5):
        value, at = read_first_pickle(content, STORAGE_MAKERS, at)
        values.append(value)
    magic, protocol, system, stored, keys = values
    if magic != TORCH_MAGIC or protocol != TORCH_PROTOCOL or system.get("little_endian") is not True:
        raise DataError("The pickle has a tensor in a format that torch does not write.", FIX)
    dtype, key, count = stored
    if keys != [key] or struct.unpack_from("<q", content, at)[0] != count:
        raise ValueError("it has a damaged storage")
    return array_of(dtype, (count,), content[at + 8 :], what="A tensor")


def _stored(arguments: tuple[Any, ...], state: Any) -> tuple[str, str, int]:
    """Return dtype, key and number of elements of a storage."""
    what, kind, key, _, count = arguments[0][:5]
    if what != "storage" or not isinstance(kind, Name) or type(count) is not int or any(arguments[0][5:]):
        raise TypeError("it has an unknown storage")
    return STORAGES[kind.text.rpartition(".")[2]], key, count


def _tensor(arguments: tuple[Any, ...], state: Any) -> Array:
    """Return what ``_rebuild_tensor_v2`` says, as an array of its own."""
    storage, offset, size, stride = arguments[:4]
    sizes = (*size, *stride, offset)
    whole = all(type(number) is int and 0 <= number < 1 << 40 for number in sizes)
    if not isinstance(storage, np.ndarray) or not whole or len(size) != len(stride) or len(size) > MAX_AXES:
        raise TypeError("it has no tensor")
    last = offset + sum((axis - 1) * step for axis, step in zip(size, stride, strict=True))
    if math.prod(size) > storage.size or (math.prod(size) and last >= storage.size):
        raise DataError("The pickle has a tensor that is larger than its storage.", FIX)
    if not math.prod(size):
        return np.empty(size, storage.dtype)
    steps = tuple(step * storage.itemsize for step in stride)
    return np.array(np.lib.stride_tricks.as_strided(storage[offset:], size, steps))


def _refuse(arguments: tuple[Any, ...], state: Any) -> Any:
    raise TypeError("a class is called")


STORAGE_MAKERS: Mapping[str, Maker] = {PERSISTENT: _stored, **{f"torch.{kind}": _refuse for kind in STORAGES}}
"""Names in what ``torch.save`` writes of a storage."""
MAKERS: Mapping[str, Maker] = {
    **{f"{module}.{name}": _dataclass(module, name) for module in MODULES
       for name in ("RemotePolicyConfig", "TimedObservation", "TimedAction")},
    **{f"numpy.{core}.multiarray._reconstruct": _array for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray.scalar": _scalar for core in ("core", "_core")},
    **{f"numpy.{core}.numeric._frombuffer": _from_buffer for core in ("core", "_core")},
    "numpy.dtype": _dtype, "numpy.ndarray": _refuse,
    "torch._utils._rebuild_tensor_v2": _tensor, "torch.storage._load_from_bytes": _storage,
    "collections.OrderedDict": _nothing,
    "lerobot.configs.types.PolicyFeature": _feature, "lerobot.configs.types.FeatureType": _first,
}  # fmt: skip
"""Name in a pickle -> what makes data of it."""


def write_actions(module: str, start: float, step: int, period_s: float, chunk: Array) -> bytes:
    """Return the pickle of a list of ``TimedAction``, for LeRobot's client: ``torch.tensor`` of numbers in each.

    Args:
        module: Module of the client's classes.
        start: Time stamp of the first action in seconds.
        step: Number of the control step of the first action.
        period_s: Time between two actions.
        chunk: (T, A), or (T,) indices.
    """
    actions = b"".join(
        _action(module, start + number * period_s, step + number, np.atleast_1d(row).tolist())
        for number, row in enumerate(chunk)
    )
    return b"\x80\x04](" + actions + b"e."


def _action(module: str, timestamp: float, timestep: int, values: Iterable[float | int]) -> bytes:
    tensor = b"ctorch\ntensor\n](" + b"".join(map(_number, values)) + b"e\x85R"
    fields = (_text("timestamp"), _number(timestamp), _text("timestep"), _number(timestep), _text("action"), tensor)
    return f"c{module}\nTimedAction\n".encode() + b")\x81}(" + b"".join(fields) + b"ub"


def _text(text: str) -> bytes:
    return b"\x8c" + bytes([len(text)]) + text.encode()


def _number(value: float | int) -> bytes:
    return b"\x8a\x08" + struct.pack("<q", value) if isinstance(value, int) else b"G" + struct.pack(">d", value)
