"""What a module's ``forward()`` reads from tensors into Python, and may decide by: a recording holds one case of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any

from vlatool.errors import require
from vlatool.module.failures import is_tool

READERS = frozenset({
    *("__bool__", "__int__", "__float__", "__index__", "__contains__", "item", "tolist", "numpy"),
    *("equal", "allclose", "is_nonzero", "__complex__", "__repr__", "__format__", "__reduce_ex__"),
    *("__array__", "__array_wrap__", "__dlpack__", "data_ptr", "storage", "untyped_storage"),
})  # fmt: skip
"""Functions of torch that turn values of tensors into values of Python."""


@dataclass
class Decisions:
    """What one run read from tensors.

    Args:
        values: place, and the truth value, number or shape that was read there, in order. Floating-point numbers are
            left out: what they lead to shows in the outputs.
        readers: places where values were read, not only shapes.
    """

    values: list[tuple[str, Any]] = field(default_factory=list)
    readers: dict[str, None] = field(default_factory=dict)

    def difference(self, other: Decisions) -> str:
        """Return the first place where another run read something else, and both values; empty for none."""
        for mine, theirs in zip_longest(self.values, other.values):
            if mine == theirs:
                continue
            if mine and theirs and mine[0] == theirs[0]:
                return f"{mine[0]} ({mine[1]} for one input, {theirs[1]} for another)"
            return f"{(mine or theirs)[0]} (reached for some inputs only)"
        return ""


def decisions_of(run: Callable[[], Any]) -> Decisions:
    """Return what a function reads from tensors while it runs."""
    found = Decisions()

    class Reading(require("torch.overrides", "build").TorchFunctionMode):  # type: ignore[misc]
        def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            result = func(*args, **(kwargs or {}))
            line = _line() if getattr(func, "__name__", "") in READERS or _is_discrete(result) else ""
            if _is_discrete(result):
                found.values.append((line, result))
            if getattr(func, "__name__", "") in READERS:
                found.readers[line] = None
            return result

    with Reading():
        run()
    return found


def _is_discrete(value: Any) -> bool:
    """Return whether a value is a truth value, a whole number, or a list of these."""
    return all(map(_is_discrete, value)) if isinstance(value, list | tuple) else isinstance(value, int)


def _line() -> str:
    """Return file and line of the policy's code, or of a library that it calls."""
    frame = sys._getframe(2)
    while is_tool(frame) and frame.f_back is not None:
        frame = frame.f_back
    return f"{os.path.basename(frame.f_code.co_filename)}:{frame.f_lineno}"
