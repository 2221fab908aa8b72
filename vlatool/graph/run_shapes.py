"""Shapes of layers that only a run can determine, stored in the file of the graph."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

METADATA_KEY = "vlatool.seen"
"""Key of the model's metadata."""


Shapes = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class RunShapes:
    """Shapes of a node in one run of its graph.

    Args:
        inputs: Shapes of its inputs in the last run, without omitted ones and weights that the engine packed.
    """

    times: int
    inputs: Shapes
    outputs: Shapes


def read_run_shapes(model: Any) -> dict[str, RunShapes]:
    """Return node -> shapes of a run; empty where the file has none, or none that can be read."""
    text = next((item.value for item in model.metadata_props if item.key == METADATA_KEY), "{}")
    try:
        return {
            str(name): RunShapes(int(times), _shapes(inputs), _shapes(outputs))
            for name, (times, inputs, outputs) in json.loads(text).items()
        }
    except (ValueError, TypeError, AttributeError):
        return {}


def _shapes(listed: Any) -> Shapes:
    return tuple(tuple(int(axis) for axis in shape) for shape in listed)


def write_run_shapes(model: Any, shapes: Mapping[str, RunShapes]) -> None:
    """Store the shapes of a run in a model, replacing earlier ones."""
    kept = [item for item in model.metadata_props if item.key != METADATA_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    if shapes:
        text = json.dumps({name: [node.times, node.inputs, node.outputs] for name, node in sorted(shapes.items())})
        model.metadata_props.add(key=METADATA_KEY, value=text)
