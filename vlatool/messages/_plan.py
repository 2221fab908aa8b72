"""How one type is encoded and decoded, worked out once from its class: runs of fields of fixed size, with tails.

The fields of a run, those of nested messages included, are read by one ``attrgetter`` and packed by one ``struct``. It
ends at a field of variable length, its tail (``_tails``). In CDR a run has a ``struct`` for each of the eight positions
where it can begin.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

import numpy as np

from vlatool.errors import BusError
from vlatool.messages._members import CODES, SIZES, Member, cache, members
from vlatool.messages._tails import LENGTH, Malformed, Numbers, Tail, Text, Texts, Wire, check_count
from vlatool.messages._wrong_values import WrongValue
from vlatool.messages.schema import Message

COUNT, NO_PATH = "uint32", ""


class Leaf(NamedTuple):
    """A field that is not a single message, with its dotted path from the message of the plan; empty: skipped."""

    path: str
    member: Member


class Step(NamedTuple):
    """A run of fields of fixed size, with the field of variable length behind it.

    Args:
        get: Returns the values of the fields of a message.
        structs: Position modulo 8 -> what packs them, with the count of the tail.
        booleans: Which of the values are truth values.
        tail: Writes and reads the last value; None where the run ends the message.
        paths: Dotted paths of the values.
    """

    get: Callable[[Any], tuple[Any, ...]]
    structs: tuple[struct.Struct, ...]
    booleans: tuple[int, ...]
    tail: Tail | None
    paths: tuple[str, ...]


@cache
def plan_of(cls: type[Message], wire: Wire) -> Plan:
    """Return the plan of a type."""
    return Plan(cls, wire)


class Plan:
    """Encodes and decodes messages of one type.

    Args:
        cls: The type.
        wire: CDR or ROS 1.
    """

    def __init__(self, cls: type[Message], wire: Wire) -> None:
        leaves, nested = _leaves(cls, wire.ros1), _nested(cls, wire.ros1)
        self.cls = cls
        self.steps = _steps(leaves, wire)
        self.smallest = sum(_smallest(leaf.member) for leaf in leaves) or int(not wire.ros1)
        """Fewest bytes of a message."""
        self._classes = tuple(kind for _, kind in nested)
        self._get_classes = _getter([f"{path}.__class__" for path, _ in nested])
        self._build = _builder(cls, wire.ros1, 0)[0]

    def write(self, message: Any, parts: list[Any], position: int) -> int:
        """Append the bytes of a message, which begin at ``position``; return where they end.

        Raises:
            ValueError, struct.error, AttributeError, TypeError, OverflowError: for a value that does not fit its field;
                ``_wrong_values.explain`` says which.
        """
        if message.__class__ is not self.cls or self._get_classes(message) != self._classes:
            raise WrongValue
        for get, structs, booleans, tail, _ in self.steps:
            values, run = get(message), structs[position & 7]
            for index in booleans:
                if not isinstance(values[index], (bool, np.bool_)):
                    raise WrongValue
            position += run.size
            if tail is None:
                parts.append(run.pack(*values))
                continue
            count, payload = tail.prepare(values[-1])
            parts.append(run.pack(*values[:-1], count) if tail.counted else run.pack(*values[:-1]))
            position = tail.write(payload, parts, position)
        return position

    def read(self, data: memoryview, position: int) -> tuple[Message, int]:
        """Return the message whose bytes begin at ``position``, and where they end.

        Raises:
            BusError: for bytes that no message has.
        """
        flat: list[Any] = []
        for _, structs, _, tail, paths in self.steps:
            run = structs[position & 7]
            if position + run.size > len(data):
                raise self._malformed(paths, f"{run.size} bytes, where {max(0, len(data) - position)} are left")
            values = run.unpack_from(data, position)
            position += run.size
            if tail is None:
                flat += values
                continue
            try:
                value, position = tail.read(data, position, values[-1] if tail.counted else 0)
            except Malformed as error:
                raise self._malformed(paths[-1:], str(error)) from None
            flat += values[:-1] if tail.counted else values
            flat.append(value)
        return self._build(flat), position

    def _malformed(self, paths: tuple[str, ...], problem: str) -> BusError:
        where = " to ".join(dict.fromkeys((paths[0], paths[-1]))) if paths else "its start"
        return BusError(
            f"A malformed {self.cls.TYPE}, at {where}: {problem}.",
            "check that the publisher sends this type, in the version of its package that is installed there",
        )


class Messages:
    """A sequence of messages of one type."""

    counted, smallest = True, 0

    def __init__(self, plan: Plan) -> None:
        self.plan = plan

    def prepare(self, value: Any) -> tuple[int, Any]:
        """Return the count of the messages, and the messages."""
        if not isinstance(value, (tuple, list)):
            raise WrongValue
        return len(value), value

    def write(self, payload: Any, parts: list[Any], position: int) -> int:
        """Append the messages."""
        for message in payload:
            position = self.plan.write(message, parts, position)
        return position

    def read(self, data: memoryview, position: int, count: int) -> tuple[Any, int]:
        """Return a tuple of the messages."""
        check_count(count, self.plan.smallest, data, position)
        messages = []
        for _ in range(count):
            message, position = self.plan.read(data, position)
            messages.append(message)
        return tuple(messages), position


def _leaves(cls: type[Message], ros1: bool, prefix: str = "") -> list[Leaf]:
    """Return the fields of a type with those of the messages in it, in the order of the wire."""
    found: list[Leaf] = []
    for member in members(cls, ros1):
        if member.message is not None and not member.sequence:
            found += _leaves(member.message, ros1, f"{prefix}{member.attribute}.")
        else:
            found.append(Leaf(prefix + member.attribute if member.attribute else NO_PATH, member))
    return found


def _nested(cls: type[Message], ros1: bool, prefix: str = "") -> list[tuple[str, type[Message]]]:
    """Return the paths of the single messages in a type, each before those in it, with their classes."""
    found = []
    for member in members(cls, ros1):
        if member.message is not None and not member.sequence:
            path = prefix + member.attribute
            found += [(path, member.message), *_nested(member.message, ros1, f"{path}.")]
    return found


def _steps(leaves: list[Leaf], wire: Wire) -> tuple[Step, ...]:
    steps: list[Step] = []
    run: list[Leaf] = []
    for leaf in leaves:
        tail = _tail(leaf.member, wire)
        run.append(leaf)
        if tail is not None:
            steps.append(_step(run, tail, wire))
            run = []
    if run or not leaves:
        steps.append(_step(run, None, wire))
    return tuple(steps)


def _tail(member: Member, wire: Wire) -> Tail | None:
    """Return what writes a field of variable length; None for one that a run packs."""
    if member.message is not None:
        return Messages(plan_of(member.message, wire))
    if member.primitive == "string":
        return Texts(wire) if member.sequence else Text(wire)
    return Numbers(wire, member.primitive, member.length) if member.sequence or member.length else None


def _step(run: list[Leaf], tail: Tail | None, wire: Wire) -> Step:
    fixed = [(leaf.path, leaf.member.primitive) for leaf in (run if tail is None else run[:-1])]
    packed = [*fixed, ("count", COUNT)] if tail is not None and tail.counted else fixed
    if not run and not wire.ros1:
        packed = [(NO_PATH, "uint8")]  # in ROS 2, a message without fields has one byte
    paths = [leaf.path for leaf in run if leaf.path != NO_PATH]
    kinds = [primitive for path, primitive in fixed if path != NO_PATH]
    align = tail.size if isinstance(tail, Numbers) and not tail.counted else 1
    structs = tuple(_struct(packed, align, start, wire) for start in range(8))
    return Step(_getter(paths), structs, tuple(i for i, kind in enumerate(kinds) if kind == "bool"), tail, tuple(paths))


def _struct(packed: list[tuple[str, str]], align: int, start: int, wire: Wire) -> struct.Struct:
    """Return what packs a run that begins at a position modulo 8, with zero bytes that align each field."""
    codes, position = [wire.order], start
    for path, primitive in packed:
        size = SIZES[primitive]
        pad = 0 if wire.ros1 else -position % size
        codes.append(f"{pad}x{size}x" if path == NO_PATH else f"{pad}x{CODES[primitive]}")
        position += pad + size
    return struct.Struct("".join(codes) + f"{0 if wire.ros1 else -position % align}x")


def _getter(paths: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Return what gets the values of these dotted paths as a tuple."""
    if not paths:
        return lambda message: ()
    get = attrgetter(*paths)
    return get if len(paths) > 1 else lambda message: (get(message),)


def _smallest(member: Member) -> int:
    if member.sequence or member.primitive == "string":
        return LENGTH
    return SIZES[member.primitive] * (member.length or 1)


def _builder(cls: type[Message], ros1: bool, start: int) -> tuple[Callable[[list[Any]], Any], int]:
    """Return what builds a message from the list of all values, its own from ``start`` on, and where they end."""
    names, getters, position, plain = [], [], start, True
    for member in members(cls, ros1):
        if not member.attribute:
            continue
        names.append(member.attribute)
        if member.message is not None and not member.sequence:
            getter, position = _builder(member.message, ros1, position)
            getters.append(getter)
            plain = False
        else:
            getters.append(itemgetter(position))
            position += 1
    if ros1 and cls.ROS1.absent:
        return lambda flat: cls(**{name: get(flat) for name, get in zip(names, getters, strict=True)}), position
    if plain:
        return lambda flat: cls(*flat[start:position]), position
    return lambda flat: cls(*[get(flat) for get in getters]), position
