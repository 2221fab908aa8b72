"""The values in a pickle, read without unpickling: no name in it is imported, and nothing in it is called.

``read_pickle`` interprets the opcodes that pickles of plain data have (protocols 2 to 5). It builds numbers, texts,
bytes, lists, tuples and mappings. A name has to be on an allow-list, and a call or an object becomes an ``Instance``
that says what stood there, no more. ``Makers`` turn those into data afterwards. Any other name, and any other opcode,
is refused by name.

Source: ``pickletools`` of the standard library, which describes every opcode.
"""

from __future__ import annotations

import pickletools
import struct
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

from vlatool.errors import DataError
from vlatool.files.validate import short_repr

MAX_OPCODES = 200_000
MAX_VALUES = 200_000
"""Values that are looked through: one that is referred to twice counts twice."""
MAX_LEVELS = 24
"""Lists, tuples, mappings and objects in each other."""
MAX_INTEGER_BYTES = 16
MAX_NAME_BYTES = 200
FIX = "send what LeRobot's client sends: numbers, texts, arrays and tensors"
OPCODES = {ord(each.code): each.name for each in pickletools.opcodes}
LITERALS: Mapping[str, Callable[[], Any]] = {
    "EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple, "NONE": lambda: None, "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
}  # fmt: skip
NUMBERS = {"BININT": "<i", "BININT1": "<B", "BININT2": "<H", "BINFLOAT": ">d"}
LENGTHS = {
    "SHORT_BINUNICODE": 1, "BINUNICODE": 4, "BINUNICODE8": 8, "SHORT_BINBYTES": 1, "BINBYTES": 4, "BINBYTES8": 8,
    "BYTEARRAY8": 8, "LONG1": 1,
}  # fmt: skip
"""Opcode -> bytes of the length of what follows."""
INDICES = {"BINPUT": "<B", "LONG_BINPUT": "<I", "BINGET": "<B", "LONG_BINGET": "<I"}
PERSISTENT = "persistent id"


class Name(NamedTuple):
    """A name in a pickle: module and attribute."""

    text: str


class Instance:
    """What a call or an object in a pickle says: nothing was called, no class is known.

    Args:
        name: Of the function or class.
        arguments: Of the call.
    """

    def __init__(self, name: str, arguments: tuple[Any, ...]) -> None:
        self.name, self.arguments = name, arguments
        self.state: Any = None
        """What the pickle would have given to the object after its construction."""


Maker = Callable[[tuple[Any, ...], Any], Any]
"""Makes data of arguments and state."""


class _Mark:
    """Begin of a group of values on the stack."""


MARK = _Mark()


def read_pickle(data: bytes, makers: Mapping[str, Maker]) -> Any:
    """Return the value in a pickle that fills ``data``.

    Args:
        makers: Name (``module.attribute``) -> what makes data of it. All other names are refused.

    Raises:
        DataError: for a name that is not allowed, naming it, and for anything else than plain data.
    """
    value, end = read_first_pickle(data, makers)
    if end != len(data):
        raise DataError(f"{len(data) - end} bytes follow the pickle.", FIX)
    return value


def read_first_pickle(data: bytes, makers: Mapping[str, Maker], start: int = 0) -> tuple[Any, int]:
    """Return the value in the pickle that begins at ``start``, and where it ends; see ``read_pickle``."""
    reader = Reader(memoryview(data), start, makers)
    try:
        value = reader.run()
        return Resolver(makers)(value), reader.at
    except DataError:
        raise
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError, struct.error, RecursionError) as error:
        raise DataError(f"The pickle is damaged before byte {reader.at}: {type(error).__name__}.", FIX) from None


class Reader:
    """A stack machine for one pickle.

    Args:
        allowed: Names that may occur in it.
    """

    def __init__(self, data: memoryview, start: int, allowed: Collection[str]) -> None:
        self._data, self.at, self._allowed = data, start, allowed
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        """Return the value at the end."""
        for _ in range(MAX_OPCODES):
            opcode = OPCODES.get(self._data[self.at], hex(self._data[self.at]))
            self.at += 1
            if opcode == "STOP":
                return self._pop()
            self._perform(opcode)
        raise DataError(f"The pickle has more than {MAX_OPCODES} opcodes.", FIX)

    def _perform(self, opcode: str) -> None:
        push = self._stack.append
        if opcode in LENGTHS:
            push(self._counted(opcode))
        elif opcode in NUMBERS:
            push(self._number(NUMBERS[opcode]))
        elif opcode in LITERALS:
            push(LITERALS[opcode]())
        elif opcode in INDICES:
            self._remember(opcode, self._number(INDICES[opcode]))
        elif (operation := OPERATIONS.get(opcode)) is not None:
            operation(self)
        else:
            raise DataError(
                f"The pickle has the opcode {opcode}, for which plain data has no use; it was not run.", FIX
            )

    def _take(self, count: int) -> bytes:
        if count > len(self._data) - self.at:
            raise ValueError("it ends early")
        self.at += count
        return bytes(self._data[self.at - count : self.at])

    def _number(self, form: str) -> Any:
        return struct.unpack(form, self._take(struct.calcsize(form)))[0]

    def _counted(self, opcode: str) -> Any:
        content = self._take(int.from_bytes(self._take(LENGTHS[opcode]), "little"))
        if "UNICODE" in opcode:
            return content.decode("utf-8")
        if opcode != "LONG1":
            return content
        if len(content) > MAX_INTEGER_BYTES:
            raise ValueError("it has a very large integer")
        return int.from_bytes(content, "little", signed=True)

    def _line(self) -> str:
        """Return the text up to the end of the line."""
        length = bytes(self._data[self.at : self.at + MAX_NAME_BYTES]).index(b"\n")
        return self._take(length + 1)[:-1].decode("ascii")

    def _remember(self, opcode: str, index: int) -> None:
        """Store in the memo, or take from it: a mapping, in which a large index takes no more than a small one."""
        if opcode.endswith("PUT"):
            self._memo[index] = self._top()
        else:
            self._stack.append(self._memo[index])

    def _top(self) -> Any:
        if self._stack[-1] is MARK:
            raise ValueError("a value is missing")
        return self._stack[-1]

    def _pop(self) -> Any:
        value = self._top()
        self._stack.pop()
        return value

    def _group(self) -> list[Any]:
        """Return the values above the last mark; they and the mark are taken off the stack."""
        start = len(self._stack) - 1
        while self._stack[start] is not MARK:
            start -= 1
            if start < 0:
                raise ValueError("there is no mark")
        group = self._stack[start + 1 :]
        del self._stack[start:]
        return group

    def _last(self, count: int) -> list[Any]:
        """Return so many values from the top, in their order."""
        return [self._pop() for _ in range(count)][::-1]

    def check_protocol(self) -> None:
        """PROTO."""
        if not 2 <= self._number("<B") <= 5:
            raise ValueError("it has an unknown protocol")

    def check_frame(self) -> None:
        """FRAME."""
        if self._number("<Q") > len(self._data) - self.at:
            raise ValueError("it ends early")

    def mark(self) -> None:
        """MARK."""
        self._stack.append(MARK)

    def memoize(self) -> None:
        """MEMOIZE."""
        self._memo[len(self._memo)] = self._top()

    def make_tuple(self, count: int | None = None) -> None:
        """TUPLE, TUPLE1, TUPLE2, TUPLE3."""
        self._stack.append(tuple(self._group() if count is None else self._last(count)))

    def append(self, values: list[Any]) -> None:
        """APPEND, APPENDS."""
        if type(self._top()) is not list:
            raise TypeError("it is not a list")
        self._top().extend(values)

    def set_items(self, values: list[Any]) -> None:
        """SETITEM, SETITEMS."""
        if type(self._top()) is not dict or len(values) % 2 or not all(type(key) is str for key in values[::2]):
            raise TypeError("it is not a mapping of names")
        self._top().update(zip(values[::2], values[1::2], strict=True))

    def name(self, module: Any, attribute: Any) -> None:
        """GLOBAL, STACK_GLOBAL."""
        text = f"{module}.{attribute}" if isinstance(module, str) and isinstance(attribute, str) else ""
        if text not in self._allowed:
            raise DataError(f"The pickle names {short_repr(text)}, which is not allowed; nothing in it was run.", FIX)
        self._stack.append(Name(text))

    def call(self) -> None:
        """REDUCE, NEWOBJ: what was to be called is noted, and nothing is."""
        function, arguments = self._last(2)
        if not isinstance(function, Name) or type(arguments) is not tuple:
            raise TypeError("what is called is not a name")
        self._stack.append(Instance(function.text, arguments))

    def build(self) -> None:
        """BUILD: the state of an object is noted."""
        state = self._pop()
        if not isinstance(self._top(), Instance) or self._top().state is not None:
            raise TypeError("what has a state is not an object")
        self._top().state = state

    def persistent_id(self) -> None:
        """BINPERSID."""
        if PERSISTENT not in self._allowed:
            raise DataError(f"The pickle has a {PERSISTENT}, which is not allowed; nothing in it was run.", FIX)
        self._stack.append(Instance(PERSISTENT, (self._pop(),)))


OPERATIONS: Mapping[str, Callable[[Reader], None]] = {
    "PROTO": Reader.check_protocol, "FRAME": Reader.check_frame, "MARK": Reader.mark, "MEMOIZE": Reader.memoize,
    "TUPLE": Reader.make_tuple, "TUPLE1": lambda self: self.make_tuple(1), "TUPLE2": lambda self: self.make_tuple(2),
    "TUPLE3": lambda self: self.make_tuple(3), "APPEND": lambda self: self.append(self._last(1)),
    "APPENDS": lambda self: self.append(self._group()), "SETITEM": lambda self: self.set_items(self._last(2)),
    "SETITEMS": lambda self: self.set_items(self._group()), "REDUCE": Reader.call, "NEWOBJ": Reader.call,
    "GLOBAL": lambda self: self.name(self._line(), self._line()),
    "STACK_GLOBAL": lambda self: self.name(*self._last(2)), "BUILD": Reader.build, "BINPERSID": Reader.persistent_id,
}  # fmt: skip


class Resolver:
    """Makes data of the instances in a value, each once, and bounds what is looked through."""

    def __init__(self, makers: Mapping[str, Maker]) -> None:
        self._makers = makers
        self._left = MAX_VALUES
        self._results: dict[int, Any] = {}

    def __call__(self, value: Any, level: int = 0) -> Any:
        """Return a value without instances.

        Raises:
            DataError: when there are too many values, or too many in each other (as in one that holds itself).
        """
        self._left -= 1
        if level > MAX_LEVELS or self._left < 0:
            raise DataError(f"The pickle has more than {MAX_VALUES} values, or {MAX_LEVELS} levels.", FIX)
        if isinstance(value, Instance):
            return self._instance(value, level)
        if isinstance(value, Name):
            return value
        if isinstance(value, list | tuple):
            return type(value)([self(item, level + 1) for item in value])
        if isinstance(value, dict):
            return {key: self(item, level + 1) for key, item in value.items()}
        return value

    def _instance(self, instance: Instance, level: int) -> Any:
        if id(instance) not in self._results:
            arguments, state = (self(part, level + 1) for part in (instance.arguments, instance.state))
            self._results[id(instance)] = self._makers[instance.name](arguments, state)
        return self._results[id(instance)]
