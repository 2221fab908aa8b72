"""Run a policy on recorded observations and collect statistics of selected activations as a stream.

No sample is stored: peak memory is one session, one sample's activations and one histogram for each tensor.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment, takes_not_finite
from vlatool.errors import DataError, GraphError
from vlatool.quantize.calibration.activation_taps import SAMPLE_LABEL, ValueTap, run_with_taps
from vlatool.quantize.calibration.ranges import Statistics
from vlatool.stage.base import Context

ValueNames = Mapping[str, Iterable[str]]
"""Graph name -> names of some of its values."""


class _StatisticsTap(ValueTap):
    """Updates the statistics of selected values."""

    def __init__(
        self, graph: str, path: Path, copy: Path, statistics: dict[str, Statistics], exempt: Collection[str],
        drops_non_finite: bool
    ) -> None:  # fmt: skip
        super().__init__(path, copy, statistics)
        self.graph, self.statistics, self._exempt, self._drops_non_finite = graph, statistics, exempt, drops_non_finite

    def observe_value(self, name: str, array: NDArray[Any]) -> None:
        """Update the statistics of a value."""
        statistics, finite = self.statistics[name], np.isfinite(array)
        statistics.finite = statistics.finite and bool(finite.all())
        if finite.all():
            statistics.add(array)
        elif name in self._exempt:
            statistics.samples += 1
        elif self._drops_non_finite:
            statistics.add(np.where(finite, array, 0))
        else:
            raise DataError(
                f"{SAMPLE_LABEL} {self.sample} makes the tensor '{name}' of the graph '{self.graph}' not "
                f"finite ({int(array.size - finite.sum())} of {array.size} values).",
                "look at that sample and at the float32 policy; int8 cannot represent what float32 cannot",
            )


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

    def tap(graph: str, file: Path, copy: Path) -> _StatisticsTap:
        return _StatisticsTap(graph, file, copy, statistics[graph], (exempt or {}).get(graph, ()), drops_non_finite)

    run_with_taps(bundle, statistics, tap, observations, context, "calibrating on", numbers)
    for graph, collected in statistics.items():
        unobserved = [name for name, of_value in collected.items() if not of_value.samples]
        if unobserved:
            raise GraphError(
                f"The graph '{graph}' was never run on calibration data, so '{unobserved[0]}' has no range.",
                "exclude that graph with --graphs, or fix the program",
            )
    return statistics
