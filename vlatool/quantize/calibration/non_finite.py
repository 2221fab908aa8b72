"""Find the values of a policy that become NaN or infinite where an input takes such values: they stay in float.

QuantizeLinear of NaN is undefined, and infinity becomes the end of a range.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment, observations_for, recorded_observations, takes_not_finite
from vlatool.graph.files import read
from vlatool.graph.layers import Layer
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.quantize.calibration.activation_taps import ValueTap, run_with_taps
from vlatool.stage.base import Context

OBSERVATIONS = 64
"""Number of recorded observations, and of observations with additional NaN and infinity."""
MOVE_OPS = ("Reshape", "Transpose", "Flatten", "Squeeze", "Unsqueeze", "Identity", "Slice", "Split", "MaxPool")
"""Operators through which an engine, or vlatool for it, may hoist a quantizer."""


class _NonFiniteTap(ValueTap):
    """Records which of the selected values are not finite."""

    def __init__(self, path: Path, copy: Path, names: Iterable[str]) -> None:
        super().__init__(path, copy, names)
        self.found: set[str] = set()

    def observe_value(self, name: str, array: NDArray[Any]) -> None:
        """Check a value that was finite so far."""
        if name not in self.found and not np.isfinite(array).all():
            self.found.add(name)


def finite_layers(bundle: Bundle, layers: Mapping[str, list[Layer]]) -> dict[str, list[Layer]]:
    """Return the layers whose inputs and outputs are always finite; all layers where no input takes other values."""
    if not takes_not_finite(bundle.manifest.spec):
        return dict(layers)
    values = {name: _quantized_values(bundle, name, selected) for name, selected in layers.items()}

    def tap(graph: str, file: Path, copy: Path) -> _NonFiniteTap:
        return _NonFiniteTap(file, copy, set().union(*values[graph].values()))

    taps = run_with_taps(bundle, values, tap, _moments(bundle), Context(), "looking for NaN in")
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
