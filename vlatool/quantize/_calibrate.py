"""Run a policy on recorded observations and let the statistics of chosen activations stream by.

Nothing of a sample is kept: peak memory is one session, one sample's activations and one histogram for each tensor.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, GraphError, require
from vlatool.graph.files import write_beside
from vlatool.quantize._ranges import Statistics
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.stage.base import Context

Wanted = Mapping[str, Iterable[str]]


class _Calibrating:
    """A session of a graph whose chosen values are outputs too; hands on what the program asked for."""

    def __init__(self, graph: str, path: Path, outputs: list[str], statistics: dict[str, Statistics]) -> None:
        self.graph = graph
        self.sample = 0
        self.statistics = statistics
        self._outputs = outputs
        self._session = engine_class()(path, 1)

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run, take in the statistics, return the graph's own outputs."""
        given = dict(self._session.run(feeds))
        for name, found in self.statistics.items():
            values = np.asarray(feeds[name] if name in feeds else given[name])
            if not np.isfinite(values).all():
                bad = int(np.size(values) - np.isfinite(values).sum())
                raise DataError(
                    f"Calibration sample {self.sample} makes the tensor '{name}' of the graph '{self.graph}' not "
                    f"finite ({bad} of {values.size} values).",
                    "look at that sample and at the float32 policy; int8 cannot represent what float32 cannot",
                )
            found.add(values)
        return {name: given[name] for name in self._outputs}


def calibrate(
    bundle: Bundle,
    wanted: Wanted,
    observations: Iterable[Mapping[str, Any]],
    context: Context,
    *,
    channels: bool = False,
    numbers: Sequence[int] = (),
) -> dict[str, dict[str, Statistics]]:
    """Collect statistics of activations.

    Args:
        bundle: A float32 bundle.
        wanted: Graph name -> names of its values.
        observations: Raw observations, consumed one at a time.
        context: For progress.
        channels: Whether the largest magnitude of each entry of the last axis is kept too.
        numbers: What messages call the observations: their places in the recording; counted from 0 when empty.

    Returns:
        Graph name -> value name -> statistics over all runs of the graph.

    Raises:
        DataError: when an observation does not fit the spec, or makes an activation that is not finite; names the
            sample and the tensor.
        GraphError: when the program never runs a graph, whose ranges would be guesses.
    """
    manifest = bundle.manifest
    sessions: dict[str, Any] = {}
    found: dict[str, dict[str, Statistics]] = {}
    with tempfile.TemporaryDirectory(prefix="vlatool-") as scratch:
        recorders = []
        for graph, names in wanted.items():
            found[graph] = {name: Statistics(channels) for name in names}
            original = bundle.file(manifest.graphs[graph].file)
            path, outputs = _with_outputs(original, list(names), Path(scratch), graph)
            recorder = _Calibrating(graph, path, outputs, found[graph])
            sessions[graph] = recorder
            recorders.append(recorder)
        for graph, described in manifest.graphs.items():
            if graph not in sessions:
                sessions[graph] = engine_class()(bundle.file(described.file), 1)
        policy = Policy(bundle, Program(manifest.program, sessions, seed=0), DEFAULT_ENGINE)
        for place, observation in enumerate(observations):
            number = numbers[place] if numbers else place
            if place % 8 == 0:
                context.tell(f"calibrating on sample {number}", place / len(numbers) if numbers else None)
            for recorder in recorders:
                recorder.sample = number
            try:
                policy.infer(observation)
            except (GraphError, DataError) as error:
                if str(error).startswith("Calibration sample"):
                    raise
                raise DataError(f"Calibration sample {number}: {error.message}", error.fix) from error
    for graph, statistics in found.items():
        idle = [name for name, each in statistics.items() if not each.samples]
        if idle:
            raise GraphError(
                f"The graph '{graph}' was never run on calibration data, so '{idle[0]}' has no range.",
                "leave that graph out with --graphs, or fix the program",
            )
    return found


def _with_outputs(path: Path, names: list[str], scratch: Path, graph: str) -> tuple[Path, list[str]]:
    """Write the graph once more with those values as outputs; return it and the outputs that it had.

    Large weights stay where they are.
    """
    onnx = require("onnx", "build")
    model = onnx.load(str(path), load_external_data=False)
    outputs = [value.name for value in model.graph.output]
    have = {*outputs, *(value.name for value in model.graph.input)}
    for name in names:
        if name not in have:
            model.graph.output.append(onnx.ValueInfoProto(name=name))
    return write_beside(model, path, scratch / f"{graph}.onnx"), outputs
