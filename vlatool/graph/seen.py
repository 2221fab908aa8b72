"""What a run has shown of layers whose shapes only a run knows, noted in the file of the graph."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

KEY = "vlatool.seen"
"""Of the model's metadata."""


Shapes = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Seen:
    """What one run of a graph has shown of a node.

    Args:
        times: How often it ran.
        inputs: Shapes of its inputs, the last time; those that it leaves out apart, and weights that the engine packed.
        outputs: Shapes of its outputs.
    """

    times: int
    inputs: Shapes
    outputs: Shapes


def read_seen(model: Any) -> dict[str, Seen]:
    """Return node -> what a run has shown; nothing where the file notes nothing, or nothing that can be read."""
    text = next((item.value for item in model.metadata_props if item.key == KEY), "{}")
    try:
        return {
            str(name): Seen(int(times), _shapes(inputs), _shapes(outputs))
            for name, (times, inputs, outputs) in json.loads(text).items()
        }
    except (ValueError, TypeError, AttributeError):
        return {}


def _shapes(listed: Any) -> Shapes:
    return tuple(tuple(int(axis) for axis in shape) for shape in listed)


def note_seen(model: Any, seen: Mapping[str, Seen]) -> None:
    """Note in a model what a run has shown, in the place of what it noted before."""
    kept = [item for item in model.metadata_props if item.key != KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    if seen:
        text = json.dumps({name: [node.times, node.inputs, node.outputs] for name, node in sorted(seen.items())})
        model.metadata_props.add(key=KEY, value=text)
