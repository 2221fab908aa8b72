"""Find the values of a policy that are NaN or infinite where an input takes that: they stay in floats.

What QuantizeLinear makes of NaN is not defined, and infinity becomes the end of a range.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment, observations_for, recorded_observations, takes_not_finite
from vlatool.files.scratch import scratch_directory
from vlatool.graph.files import read
from vlatool.graph.layers import Layer
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.quantize.calibration.activation_taps import Watcher, run_watched
from vlatool.stage.base import Context

ASKED = 64
"""Observations of each sort, recorded ones as they are and with more such values."""
MOVES = ("Reshape", "Transpose", "Flatten", "Squeeze", "Unsqueeze", "Identity", "Slice", "Split", "MaxPool")
"""Operators before which an engine, or vlatool for it, may quantize what is read behind them."""


class _Looking(Watcher):
    """Notes which of chosen values are not finite."""

    def __init__(self, path: Path, copy: Path, names: Iterable[str]) -> None:
        self.found: set[str] = set()
        self._names = set(names)
        super().__init__(path, copy, self._show)

    def _show(self, graph: OnnxGraph) -> None:
        known = graph.outputs.union(value.name for value in graph.graph.input)
        graph.graph.output.extend(graph.onnx.ValueInfoProto(name=name) for name in sorted(self._names - known))

    def watch(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Look at the values that were finite so far."""
        self.found |= {
            name for name in self._names - self.found
            if not np.isfinite(np.asarray(feeds[name] if name in feeds else values[name])).all()
        }  # fmt: skip


def finite_layers(bundle: Bundle, layers: Mapping[str, list[Layer]]) -> dict[str, list[Layer]]:
    """Return those of the layers that read and give finite values alone; all, where every input takes no others.

    Args:
        bundle: A float32 bundle.
        layers: Graph name -> layers.
    """
    if not takes_not_finite(bundle.manifest.spec):
        return dict(layers)
    touched = {name: _touched(bundle, name, chosen) for name, chosen in layers.items()}
    with scratch_directory() as scratch:
        watchers = {
            name: _Looking(
                bundle.file(bundle.manifest.graphs[name].file),
                scratch / f"{name}.onnx",
                set().union(*of_layer.values()),
            )
            for name, of_layer in touched.items()
        }
        run_watched(bundle, watchers, _moments(bundle), Context(), "looking for NaN in")
    return {
        name: [layer for layer in chosen if watchers[name].found.isdisjoint(touched[name][layer.name])]
        for name, chosen in layers.items()
    }


def _moments(bundle: Bundle) -> Iterator[Moment]:
    recorded = recorded_observations(bundle, ASKED)
    for number, observation in enumerate((*recorded, *observations_for(bundle, ASKED))):
        yield Moment(observation, number, begins=True)


def _touched(bundle: Bundle, name: str, layers: Iterable[Layer]) -> dict[str, set[str]]:
    """Return layer -> the values that are quantized for it, or may be before what moves them."""
    graph = OnnxGraph(read(bundle.file(bundle.manifest.graphs[name].file)))
    touched = {}
    for layer in layers:
        values = [*layer.activations, *filter(None, [layer.output])]
        for value in values:  # grows while it is gone through
            node = graph.producers.get(value)
            if node is not None and node.op_type in MOVES:
                values.append(node.input[0])
        touched[layer.name] = set(values)
    return touched
