"""Run a policy on recorded observations and collect statistics of selected activations as a stream.

No sample is stored: peak memory is one session, one sample's activations and one histogram for each tensor.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment, takes_not_finite
from vlatool.errors import DataError, GraphError
from vlatool.files.scratch import scratch_directory
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.quantize.calibration.activation_taps import SAMPLE_LABEL, ActivationTap, run_with_taps
from vlatool.quantize.calibration.ranges import Statistics
from vlatool.stage.base import Context

ValueNames = Mapping[str, Iterable[str]]
"""Graph name -> names of some of its values."""


class _StatisticsTap(ActivationTap):
    """Updates the statistics of selected values."""

    def __init__(
        self, graph: str, path: Path, scratch: Path, statistics: dict[str, Statistics], exempt: Collection[str],
        drops_non_finite: bool
    ) -> None:  # fmt: skip
        self.graph, self.statistics, self._exempt, self._drops_non_finite = graph, statistics, exempt, drops_non_finite
        super().__init__(path, scratch / f"{graph}.onnx", self._add_outputs)

    def _add_outputs(self, graph: OnnxGraph) -> None:
        known = graph.outputs.union(value.name for value in graph.graph.input)
        graph.graph.output.extend(graph.onnx.ValueInfoProto(name=name) for name in self.statistics if name not in known)

    def observe(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Update the statistics."""
        for name, statistics in self.statistics.items():
            array = np.asarray(feeds[name] if name in feeds else values[name])
            if not np.isfinite(array).all():
                if name in self._exempt:
                    statistics.finite = False
                    statistics.samples += 1
                    continue
                if self._drops_non_finite:
                    statistics.finite = False
                    statistics.add(np.where(np.isfinite(array), array, 0))
                    continue
                bad = int(np.size(array) - np.isfinite(array).sum())
                raise DataError(
                    f"{SAMPLE_LABEL} {self.sample} makes the tensor '{name}' of the graph '{self.graph}' not "
                    f"finite ({bad} of {array.size} values).",
                    "look at that sample and at the float32 policy; int8 cannot represent what float32 cannot",
                )
            statistics.add(array)


def calibrate(
    bundle: Bundle,
    values: ValueNames,
    observations: Iterable[Mapping[str, Any] | Moment],
    context: Context,
    *,
    channels: bool = False,
    numbers: Sequence[int] = (),
    exempt: Mapping[str, Collection[str]] | None = None,
) -> dict[str, dict[str, Statistics]]:
    """Collect statistics of activations.

    Args:
        observations: Raw ones, or encoded for the graphs (``Encoded``), consumed one at a time; see ``run_with_taps``.
        channels: Whether the largest magnitude of each entry of the last axis is collected, too.
        numbers: Indices of the observations in the recording, for messages; counted from 0 when empty.
        exempt: Graph name -> values that may be NaN or infinite, which their statistics then record.

    Returns:
        Graph name -> value name -> statistics over all runs of the graph; where an input takes NaN and infinity, of
        the finite values alone.

    Raises:
        DataError: when an observation does not fit the spec, or makes an activation that is not finite; names the
            sample and the tensor.
        GraphError: when the program never runs a graph, whose ranges would be guesses.
    """
    statistics = {graph: {name: Statistics(channels) for name in names} for graph, names in values.items()}
    drops_non_finite = bool(takes_not_finite(bundle.manifest.spec))
    with scratch_directory() as scratch:
        files = {graph: bundle.file(bundle.manifest.graphs[graph].file) for graph in statistics}
        taps = {
            name: _StatisticsTap(name, file, scratch, statistics[name], (exempt or {}).get(name, ()), drops_non_finite)
            for name, file in files.items()
        }
        run_with_taps(bundle, taps, observations, context, "calibrating on", numbers)
    for graph, collected in statistics.items():
        unobserved = [name for name, of_value in collected.items() if not of_value.samples]
        if unobserved:
            raise GraphError(
                f"The graph '{graph}' was never run on calibration data, so '{unobserved[0]}' has no range.",
                "exclude that graph with --graphs, or fix the program",
            )
    return statistics
