"""Find the values of a policy that become NaN or infinite where an input takes such values: they stay in float.

QuantizeLinear of NaN is undefined, and infinity becomes the end of a range.
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
from vlatool.quantize.calibration.activation_taps import ActivationTap, run_with_taps
from vlatool.stage.base import Context

OBSERVATIONS = 64
"""Number of recorded observations, and of observations with additional NaN and infinity."""
MOVE_OPS = ("Reshape", "Transpose", "Flatten", "Squeeze", "Unsqueeze", "Identity", "Slice", "Split", "MaxPool")
"""Operators through which an engine, or vlatool for it, may hoist a quantizer."""


class _NonFiniteTap(ActivationTap):
    """Records which of the selected values are not finite."""

    def __init__(self, path: Path, copy: Path, names: Iterable[str]) -> None:
        self.found: set[str] = set()
        self._names = set(names)
        super().__init__(path, copy, self._add_outputs)

    def _add_outputs(self, graph: OnnxGraph) -> None:
        known = graph.outputs.union(value.name for value in graph.graph.input)
        graph.graph.output.extend(graph.onnx.ValueInfoProto(name=name) for name in sorted(self._names - known))

    def observe(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Check the values that were finite so far."""
        self.found |= {
            name for name in self._names - self.found
            if not np.isfinite(np.asarray(feeds[name] if name in feeds else values[name])).all()
        }  # fmt: skip


def finite_layers(bundle: Bundle, layers: Mapping[str, list[Layer]]) -> dict[str, list[Layer]]:
    """Return the layers whose inputs and outputs are always finite; all layers where no input takes other values."""
    if not takes_not_finite(bundle.manifest.spec):
        return dict(layers)
    values = {name: _quantized_values(bundle, name, selected) for name, selected in layers.items()}
    with scratch_directory() as scratch:
        taps = {
            name: _NonFiniteTap(
                bundle.file(bundle.manifest.graphs[name].file),
                scratch / f"{name}.onnx",
                set().union(*of_layer.values()),
            )
            for name, of_layer in values.items()
        }
        run_with_taps(bundle, taps, _moments(bundle), Context(), "looking for NaN in")
    return {
        name: [layer for layer in selected if taps[name].found.isdisjoint(values[name][layer.name])]
        for name, selected in layers.items()
    }


def _moments(bundle: Bundle) -> Iterator[Moment]:
    recorded = recorded_observations(bundle, OBSERVATIONS)
    for number, observation in enumerate((*recorded, *observations_for(bundle, OBSERVATIONS))):
        yield Moment(observation, number, begins=True)


def _quantized_values(bundle: Bundle, name: str, layers: Iterable[Layer]) -> dict[str, set[str]]:
    """Return layer -> the values that are quantized for it, or may be after hoisting."""
    graph = OnnxGraph(read(bundle.file(bundle.manifest.graphs[name].file)))
    by_layer = {}
    for layer in layers:
        values = [*layer.activations, *filter(None, [layer.output])]
        for value in values:  # grows during the loop
            node = graph.producers.get(value)
            if node is not None and node.op_type in MOVE_OPS:
                values.append(node.input[0])
        by_layer[layer.name] = set(values)
    return by_layer
