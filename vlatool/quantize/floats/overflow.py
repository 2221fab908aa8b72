"""Find the values of a policy that overflow a narrower float type, on recorded observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.quantize.calibration.activation_taps import ActivationTap, run_with_taps
from vlatool.stage.base import Context

PEAKS = "vlatool.peaks"
ZERO_NAME, ONE_NAME = "vlatool.zero", "vlatool.one"


@dataclass
class Overflow:
    """A value that is too large.

    Args:
        sample: First observation on which it overflows.
        largest: Its largest finite magnitude over all observations.
    """

    sample: int
    largest: float


class _PeakTap(ActivationTap):
    """Records the values that are too large, from the largest magnitude of every value."""

    def __init__(self, path: Path, copy: Path, limit: float) -> None:
        self.overflows: dict[str, Overflow] = {}
        self._limit = limit
        super().__init__(path, copy)

    def add_outputs(self, graph: OnnxGraph) -> None:
        """Add the largest finite magnitude of each float32 value, as one output."""
        self._names = graph.float_values()
        peaks = [f"{PEAKS}.{number}" for number in range(len(self._names))]
        for name, peak in zip(self._names, peaks, strict=True):
            graph.graph.node.extend(
                [
                    graph.node("Abs", [name], [f"{peak}.abs"]),
                    graph.node("IsInf", [name], [f"{peak}.inf"]),
                    graph.node("Where", [f"{peak}.inf", ZERO_NAME, f"{peak}.abs"], [f"{peak}.finite"]),
                    graph.node("ReduceMax", [f"{peak}.finite"], [f"{peak}.peak"], keepdims=0),
                    graph.node("Reshape", [f"{peak}.peak", ONE_NAME], [peak]),
                ]
            )
        if not peaks:
            return
        graph.graph.node.append(graph.node("Concat", peaks, [PEAKS], axis=0))
        graph.add(ZERO_NAME, 0, np.float32)
        graph.add(ONE_NAME, [1], np.int64)
        graph.graph.output.append(graph.onnx.ValueInfoProto(name=PEAKS))

    def observe(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Update the overflows."""
        peaks = np.asarray(values.get(PEAKS, ()))
        for index in np.flatnonzero(peaks > self._limit):
            known = self.overflows.setdefault(self._names[index], Overflow(self.sample, 0.0))
            known.largest = max(known.largest, float(peaks[index]))


def find_overflows(
    bundle: Bundle,
    graphs: Iterable[str],
    observations: Iterable[Mapping[str, Any] | Moment],
    limit: float,
    context: Context,
) -> dict[str, dict[str, Overflow]]:
    """Return graph -> value -> where it exceeds ``limit``; infinity does not count, since every float type has it.

    Args:
        observations: Raw observations, consumed one at a time; see ``run_with_taps``.
        limit: Largest finite magnitude that is allowed.

    Raises:
        DataError: when an observation does not fit the spec; names the sample.
    """

    def tap(_graph: str, file: Path, copy: Path) -> _PeakTap:
        return _PeakTap(file, copy, limit)

    taps = run_with_taps(bundle, graphs, tap, observations, context, "looking for large values in")
    return {graph: tap.overflows for graph, tap in taps.items()}
