"""Find the values of a policy that grow beyond what a narrower float type holds, on recorded observations."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, GraphError, require
from vlatool.graph.files import write_beside
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.stage.base import Context

PEAKS = "vlatool.peaks"
ZERO, ONE = "vlatool.zero", "vlatool.one"


@dataclass
class Beyond:
    """A value that is too large.

    Args:
        sample: The first observation that makes it so.
        largest: Its largest finite magnitude over all observations.
    """

    sample: int
    largest: float


class _Watching:
    """A session of a graph that also gives the largest magnitude of every value; the values themselves are not kept."""

    def __init__(self, path: Path, outputs: list[str], names: list[str], limit: float) -> None:
        self.sample = 0
        self.found: dict[str, Beyond] = {}
        self._outputs, self._names, self._limit = outputs, names, limit
        self._session = engine_class()(path, 1)

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run, take in the peaks, return the graph's own outputs."""
        given = self._session.run(feeds)
        peaks = np.asarray(given[PEAKS])
        for index in np.flatnonzero(peaks > self._limit):
            known = self.found.setdefault(self._names[index], Beyond(self.sample, 0.0))
            known.largest = max(known.largest, float(peaks[index]))
        return {name: given[name] for name in self._outputs}


def find_beyond(
    bundle: Bundle, graphs: Iterable[str], observations: Iterable[Mapping[str, Any]], limit: float, context: Context
) -> dict[str, dict[str, Beyond]]:
    """Return graph -> value -> where it goes beyond ``limit``; infinity does not count, every float type has it.

    Args:
        bundle: A float32 bundle.
        graphs: Names of the graphs that are watched.
        observations: Raw observations, consumed one at a time.
        limit: Largest finite magnitude that is allowed.
        context: For progress.

    Raises:
        DataError: when an observation does not fit the spec; names the sample.
    """
    policy = Policy.open(bundle, engine=DEFAULT_ENGINE, threads=1, seed=0)
    sessions: dict[str, Any] = dict(policy.program.sessions)
    watching: dict[str, _Watching] = {}
    with tempfile.TemporaryDirectory(prefix="vlatool-") as scratch:
        for graph in graphs:
            path, names = _with_peaks(bundle.file(bundle.manifest.graphs[graph].file), Path(scratch), graph)
            if names:
                sessions[graph] = watching[graph] = _Watching(path, sessions[graph].outputs, names, limit)
        policy.program = Program(policy.program.steps, sessions, seed=0)
        for number, observation in enumerate(observations):
            if number % 8 == 0:
                context.tell(f"looking for large values in sample {number}", None)
            for watcher in watching.values():
                watcher.sample = number
            try:
                policy.infer(observation)
            except (GraphError, DataError) as error:
                raise DataError(f"Calibration sample {number}: {error.message}", error.fix) from error
    return {graph: watcher.found for graph, watcher in watching.items()}


def _with_peaks(path: Path, scratch: Path, graph: str) -> tuple[Path, list[str]]:
    """Write the graph once more with the largest magnitudes of its float32 values as one output, and their names."""
    onnx = require("onnx", "build")
    model = onnx.load(str(path), load_external_data=False)
    names, make = OnnxGraph(model).float_values(), onnx.helper.make_node
    for number, name in enumerate(names):
        own = f"{PEAKS}.{number}"
        model.graph.node.extend(
            [
                make("Abs", [name], [f"{own}.abs"]),
                make("IsInf", [name], [f"{own}.inf"]),
                make("Where", [f"{own}.inf", ZERO, f"{own}.abs"], [f"{own}.finite"]),
                make("ReduceMax", [f"{own}.finite"], [f"{own}.peak"], keepdims=0),
                make("Reshape", [f"{own}.peak", ONE], [own]),
            ]
        )
    model.graph.node.append(make("Concat", [f"{PEAKS}.{number}" for number in range(len(names))], [PEAKS], axis=0))
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.zeros((), np.float32), ZERO))
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.ones(1, np.int64), ONE))
    model.graph.output.append(onnx.ValueInfoProto(name=PEAKS))
    return write_beside(model, path, scratch / f"{graph}.onnx"), names
