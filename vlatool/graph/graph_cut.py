"""A part that is cut out of a graph, to be run on its own before the rest."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class GraphCut:
    """The part of a graph that was cut out.

    Args:
        model: an ``onnx.ModelProto`` or ``onnx_ir.Model``, as the graph, that computes ``values`` from ``inputs``.
        inputs: inputs of the original graph that it reads.
        values: values that the rest of the graph reads from it.
        kept: inputs of the original graph that the rest still reads.
    """

    model: Any
    inputs: tuple[str, ...]
    values: tuple[str, ...]
    kept: tuple[str, ...]


def names_of(values: Iterable[Any]) -> tuple[str, ...]:
    """Return the names of values of a graph."""
    return tuple(value.name for value in values)
