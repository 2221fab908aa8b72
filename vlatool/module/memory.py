"""What a module remembers from call to call, and whether its outputs depend on it: an exported graph remembers nothing.

A buffer that ``forward()`` changes is found in what torch.export traced (``changed_buffers``). Attributes that are not
buffers (a counter, a list of past observations) leave no trace there: they are found by running the module, and by
putting other values into those that changed.
"""

from __future__ import annotations

import copy
import dataclasses
import types
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.data import observations_for
from vlatool.errors import VlatoolError, require
from vlatool.module.changed_buffers import forgets
from vlatool.module.torch_policy import TorchSession
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.program import Program

if TYPE_CHECKING:
    from torch import Tensor, nn

COUNTER_VALUES = (0, *(2**power for power in range(21)))
"""Values that a counter is given: it may take effect after thousands of steps."""
PERTURBATIONS = (0.0, -1.0, 1e3, -1e3)
"""What the numbers of other attributes are multiplied by, after 1 is added."""
LIST_GROWTH = 32
"""How many times as long a list is made: it may take effect once it is full."""
TOLERANCE = 1e-5
"""Relative and absolute difference of outputs up to which they are equal."""


def refuse_hidden_state(bundle: Bundle, modules: Mapping[str, nn.Module]) -> None:
    """Run a policy on two observations and look at all its modules with ``refuse_kept_values``.

    What changes modules looks before it begins: a trace holds for ever what an attribute was, and a training of single
    observations learns nothing of it.

    Raises:
        SourceError: naming the attribute.
    """
    sessions = {step.graph: TorchSession(modules[step.graph], step) for step in bundle.manifest.program}
    program = Program(bundle.manifest.program, sessions, seed=0)
    encode = ObservationEncoder(bundle.manifest.spec, bundle)
    for observation in observations_for(bundle, 2):
        program.run(encode(observation))
    for session in sessions.values():
        refuse_kept_values(session.module, session.step, session.last_feeds)


def refuse_kept_values(module: nn.Module, step: ProgramStep, feeds: Sequence[Mapping[str, Any]]) -> None:
    """Run a module on different inputs and see whether it changes an attribute that its outputs depend on.

    Args:
        step: what it is fed and gives.
        feeds: two inputs or more, arrays by name; of one alone nothing is learnt.

    Raises:
        SourceError: naming the attribute.
    """
    if len(feeds) < 2:
        return
    _run(module, step, feeds[0])
    before = {key: _plain(value) for key, value in _attributes(module)}
    expected = _run(module, step, feeds[1])
    after = {key: value for key, value in _attributes(module) if _differ(before.get(key), _plain(value))}
    for (owner, name), value in after.items():
        original = _copy(value)
        try:
            for other in (original, *_alternatives(original)):
                _put(module, owner, name, _copy(other))
                if not _equal(_try(module, step, feeds[1]), expected):
                    raise forgets(step.graph, f"'{f'{owner}.{name}'.lstrip('.')}'")
        finally:
            _put(module, owner, name, original)


def _attributes(module: nn.Module) -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield (module, name) -> value of all that is neither parameter nor module nor torch's own."""
    usual = {*vars(require("torch", "build").nn.Module())}
    for owner, part in module.named_modules():
        for name, value in [*part._buffers.items(), *vars(part).items()]:
            if name not in usual and _plain(value) is not None:
                yield (owner, name), value


def _plain(value: Any) -> Any:
    """Return a value that can be compared later, None unless it consists of numbers, texts and tensors."""
    torch = require("torch", "build")
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, deque)):
        return [_plain(item) for item in value]
    return _plain(_fields(value)) if _is_record(value) else None


def _is_record(value: Any) -> bool:
    """Say whether a value is an object of named fields."""
    return isinstance(value, types.SimpleNamespace) or (dataclasses.is_dataclass(value) and not isinstance(value, type))


def _fields(record: Any) -> dict[str, Any]:
    if isinstance(record, types.SimpleNamespace):
        return vars(record)
    return {each.name: getattr(record, each.name) for each in dataclasses.fields(record)}


def _record_of(like: Any, fields: Mapping[str, Any]) -> Any:
    made = copy.copy(like)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


def _differ(one: Any, other: Any) -> bool:
    torch = require("torch", "build")
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.shape != other.shape or not torch.equal(one, other)
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() != other.keys() or any(_differ(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) != len(other) or any(map(_differ, one, other))
    return type(one) is not type(other) or bool(one != other)


def _copy(value: Any) -> Any:
    """Return a copy that forward() does not change in place."""
    if isinstance(value, require("torch", "build").Tensor):
        return value.detach().clone()
    if isinstance(value, Mapping):
        return {key: _copy(item) for key, item in value.items()}
    if isinstance(value, (list, deque)):
        return _rebuild(value, [_copy(item) for item in value])
    return _record_of(value, _copy(_fields(value))) if _is_record(value) else value


def _alternatives(value: Any) -> Iterator[Any]:
    """Yield other values of the kind of an attribute."""
    torch = require("torch", "build")
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from COUNTER_VALUES
    elif isinstance(value, torch.Tensor) and value.numel() == 1:
        yield from (torch.full_like(value, count) for count in COUNTER_VALUES if value.dtype != torch.bool)
    elif isinstance(value, (float, torch.Tensor)) and getattr(value, "dtype", None) != torch.bool:
        yield from ((value + 1) * factor for factor in PERTURBATIONS)
    elif isinstance(value, (list, deque)):
        for items in ([], [*value] * LIST_GROWTH):
            yield _rebuild(value, items)
        for index in range(len(PERTURBATIONS)):
            yield _rebuild(value, [_one_of(item, index) for item in value] * LIST_GROWTH)
    elif isinstance(value, dict):
        yield {}
        yield from _with_alternatives(value)
    elif _is_record(value):
        yield from (_record_of(value, fields) for fields in _with_alternatives(_fields(value)))


def _with_alternatives(fields: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a mapping with other values."""
    most = max((len([*_alternatives(item)]) for item in fields.values()), default=0)
    yield from ({key: _one_of(item, index) for key, item in fields.items()} for index in range(most))


def _rebuild(like: Any, items: list[Any]) -> Any:
    return deque(items, like.maxlen) if isinstance(like, deque) else items


def _one_of(value: Any, index: int) -> Any:
    others = list(_alternatives(value))
    return others[index % len(others)] if others else value


def _put(module: nn.Module, owner: str, name: str, value: Any) -> None:
    setattr(module.get_submodule(owner), name, value)


def _try(module: nn.Module, step: ProgramStep, feeds: Mapping[str, Any]) -> list[Tensor] | None:
    """Return the outputs, None where the module cannot run with what was put into it."""
    try:
        return _run(module, step, feeds)
    except VlatoolError:
        return None


def _run(module: nn.Module, step: ProgramStep, feeds: Mapping[str, Any]) -> list[Tensor]:
    torch = require("torch", "build")
    outputs = TorchSession(module, step).run(feeds)
    return [torch.from_numpy(outputs[name]).clone() for name in step.gives]


def _equal(got: list[Tensor] | None, expected: list[Tensor]) -> bool:
    torch = require("torch", "build")
    return got is not None and all(
        one.shape == other.shape and torch.allclose(one.double(), other.double(), TOLERANCE, TOLERANCE, equal_nan=True)
        for one, other in zip(got, expected, strict=True)
    )
