"""Run a policy on recorded observations and let the statistics of chosen activations stream by.

Nothing of a sample is kept: peak memory is one session, one sample's activations and one histogram for each tensor.
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
from vlatool.quantize.calibration.activation_taps import SAMPLE, Watcher, run_watched
from vlatool.quantize.calibration.ranges import Statistics
from vlatool.stage.base import Context

Values = Mapping[str, Iterable[str]]
"""Graph name -> names of its values."""


class _Calibrating(Watcher):
    """Adds chosen values to their statistics."""

    def __init__(
        self,
        graph: str,
        path: Path,
        scratch: Path,
        statistics: dict[str, Statistics],
        spared: Collection[str],
        ignores: bool,
    ) -> None:
        self.graph, self.statistics, self._spared, self._ignores = graph, statistics, spared, ignores
        super().__init__(path, scratch / f"{graph}.onnx", self._show)

    def _show(self, graph: OnnxGraph) -> None:
        known = graph.outputs.union(value.name for value in graph.graph.input)
        graph.graph.output.extend(graph.onnx.ValueInfoProto(name=name) for name in self.statistics if name not in known)

    def watch(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Take in the statistics."""
        for name, statistics in self.statistics.items():
            array = np.asarray(feeds[name] if name in feeds else values[name])
            if not np.isfinite(array).all():
                if name in self._spared:
                    statistics.finite = False
                    statistics.samples += 1
                    continue
                if self._ignores:
                    statistics.finite = False
                    statistics.add(np.where(np.isfinite(array), array, 0))
                    continue
                bad = int(np.size(array) - np.isfinite(array).sum())
                raise DataError(
                    f"{SAMPLE} {self.sample} makes the tensor '{name}' of the graph '{self.graph}' not "
                    f"finite ({bad} of {array.size} values).",
                    "look at that sample and at the float32 policy; int8 cannot represent what float32 cannot",
                )
            statistics.add(array)


def calibrate(
    bundle: Bundle,
    values: Values,
    observations: Iterable[Mapping[str, Any] | Moment],
    context: Context,
    *,
    channels: bool = False,
    numbers: Sequence[int] = (),
    spared: Mapping[str, Collection[str]] | None = None,
) -> dict[str, dict[str, Statistics]]:
    """Collect statistics of activations.

    Args:
        bundle: A float32 bundle.
        values: What is looked at.
        observations: Raw ones, or as the graphs take them (``Encoded``), consumed one at a time; see ``run_watched``.
        context: For progress.
        channels: Whether the largest magnitude of each entry of the last axis is kept too.
        numbers: What messages call the observations: their places in the recording; counted from 0 when empty.
        spared: Graph name -> values that may be NaN or infinite, which their statistics then say.

    Returns:
        Graph name -> value name -> statistics over all runs of the graph; where an input takes NaN and infinity, of
        the finite values alone.

    Raises:
        DataError: when an observation does not fit the spec, or makes an activation that is not finite; names the
            sample and the tensor.
        GraphError: when the program never runs a graph, whose ranges would be guesses.
    """
    statistics = {graph: {name: Statistics(channels) for name in names} for graph, names in values.items()}
    ignores = bool(takes_not_finite(bundle.manifest.spec))
    with scratch_directory() as scratch:
        files = {graph: bundle.file(bundle.manifest.graphs[graph].file) for graph in statistics}
        watchers = {
            graph: _Calibrating(graph, file, scratch, statistics[graph], (spared or {}).get(graph, ()), ignores)
            for graph, file in files.items()
        }
        run_watched(bundle, watchers, observations, context, "calibrating on", numbers)
    for graph, collected in statistics.items():
        idle = [name for name, of_value in collected.items() if not of_value.samples]
        if idle:
            raise GraphError(
                f"The graph '{graph}' was never run on calibration data, so '{idle[0]}' has no range.",
                "leave that graph out with --graphs, or fix the program",
            )
    return statistics
