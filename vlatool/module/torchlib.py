"""Torch's table of the ONNX functions that its exporter writes, built once in a process instead of once per graph.

Building it parses the source of each function, longer than the rest of a small export takes. The table is internal to
torch: a release that keeps it otherwise builds it each time, as it did.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator
from typing import Any

_tables: dict[Any, Any] = {}
"""Arguments of the builder -> table."""


@contextlib.contextmanager
def shared_table() -> Iterator[None]:
    """Let exports of this block, one at a time, share the table; each gets a copy, since it may add to it."""
    registry = _registry()
    if registry is None:
        yield
        return
    original = registry.__dict__["from_torchlib"]

    def from_torchlib(kind: Any, /, **options: Any) -> Any:
        key = tuple(sorted(options.items()))
        if key not in _tables:
            _tables[key] = original.__get__(None, kind)(**options)
        table = copy.copy(_tables[key])
        table.functions = {name: list(functions) for name, functions in table.functions.items()}
        return table

    registry.from_torchlib = classmethod(from_torchlib)
    try:
        yield
    finally:
        registry.from_torchlib = original


def build(opset: int) -> None:
    """Build the table of an opset ahead of the first export."""
    registry = _registry()
    if registry is not None:
        with shared_table():
            registry.from_torchlib(opset_version=opset)


def _registry() -> Any:
    """Return torch's class of the table, or None where this release has none of the known shape."""
    try:
        from torch.onnx._internal.exporter._registration import ONNXRegistry
    except ImportError:
        return None
    known = isinstance(ONNXRegistry.__dict__.get("from_torchlib"), classmethod) and hasattr(ONNXRegistry(), "functions")
    return ONNXRegistry if known else None
