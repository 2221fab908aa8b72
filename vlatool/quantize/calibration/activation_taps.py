"""Run a policy on recorded observations and observe selected values inside its graphs, without storing them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment
from vlatool.errors import DataError, GraphError, require
from vlatool.files.scratch import scratch_directory
from vlatool.graph.files import write_linked
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.contract import off_the_robot
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class
from vlatool.runtime.graph_files import open_graph
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.stage.base import Context

TapT = TypeVar("TapT", bound="ActivationTap")
SAMPLE_FIX = "remove that sample from the recording, or correct the policy where it may come"
SAMPLE_LABEL = "Calibration sample"


class ActivationTap:
    """A session of a graph with additional outputs, which are hidden from the program.

    Args:
        path: File of the graph; large weights stay in their files.
        copy: Path of the copy with additional outputs.
    """

    def __init__(self, path: Path, copy: Path) -> None:
        graph = OnnxGraph(require("onnx", "build").load(str(path), load_external_data=False))
        self.sample = 0
        self.observing = True
        self._outputs = [value.name for value in graph.graph.output]
        self.add_outputs(graph)
        self._description = f"the graph '{path.stem}' with additional outputs"
        with engine_call(engine_class(), f"opened {self._description}"):
            self._session = engine_class()(write_linked(graph.model, path, copy), 1)

    def add_outputs(self, graph: OnnxGraph) -> None:
        """Add the outputs to observe."""
        raise NotImplementedError

    def observe(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Observe inputs and outputs of one run."""
        raise NotImplementedError

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph, observe the values, return the graph's own outputs."""
        with engine_call(engine_class(), f"ran {self._description}"):
            values = self._session.run(feeds)
        if self.observing:
            self.observe(feeds, values)
        return {name: values[name] for name in self._outputs}


class ValueTap(ActivationTap):
    """Observes values by name, inputs of the graph among them."""

    def __init__(self, path: Path, copy: Path, names: Iterable[str]) -> None:
        self.names = sorted(names)
        super().__init__(path, copy)

    def add_outputs(self, graph: OnnxGraph) -> None:
        """Add the values that are neither inputs nor outputs."""
        known = graph.outputs.union(value.name for value in graph.graph.input)
        graph.graph.output.extend(graph.onnx.ValueInfoProto(name=name) for name in self.names if name not in known)

    def observe(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Observe each value."""
        for name in self.names:
            self.observe_value(name, np.asarray(feeds[name] if name in feeds else values[name]))

    def observe_value(self, name: str, array: NDArray[Any]) -> None:
        """Observe one value of one run."""
        raise NotImplementedError


def run_with_taps(
    bundle: Bundle,
    graphs: Iterable[str],
    tap: Callable[[str, Path, Path], TapT],
    observations: Iterable[Mapping[str, Any] | Moment],
    context: Context,
    activity: str,
    numbers: Sequence[int] = (),
) -> dict[str, TapT]:
    """Run a policy with taps on some of its graphs; return graph name -> tap.

    Args:
        tap: Name of a graph, its file, path of the copy with additional outputs -> its tap.
        observations: Raw ones, or encoded for the graphs (``Encoded``), consumed one at a time. Moments that do not
            count are not observed, and the policy is reset where an episode begins.
        activity: Description of the work in progress messages, before the words "sample 3".
        numbers: Indices of the observations in the recording, for messages; counted from 0 when empty.

    Raises:
        DataError: when an observation does not fit the spec, or a tap refuses a value; names the sample.
    """
    manifest = bundle.manifest
    with scratch_directory() as scratch:
        taps = {name: tap(name, bundle.file(manifest.graphs[name].file), scratch / f"{name}.onnx") for name in graphs}
        others = {name: open_graph(bundle, manifest.graphs[name], engine_class(), 1)
                  for name in manifest.graphs if name not in taps}  # fmt: skip
        policy = Policy(bundle, Program(manifest.program, {**others, **taps}, seed=0), DEFAULT_ENGINE)
        for index, each in enumerate(observations):
            moment = each if isinstance(each, Moment) else Moment(each, numbers[index] if numbers else index)
            number = moment.number
            if index % 8 == 0:
                context.progress(f"{activity} sample {number}", index / len(numbers) if index < len(numbers) else None)
            for each_tap in taps.values():
                each_tap.sample, each_tap.observing = number, moment.counts
            if moment.begins:
                policy.reset(number)
            try:
                with off_the_robot("what was recorded", SAMPLE_FIX):
                    policy.infer(moment.observation)
            except (GraphError, DataError) as error:
                if error.message.startswith(SAMPLE_LABEL):
                    raise
                raise DataError(f"{SAMPLE_LABEL} {number}: {error.message}", error.fix) from error
    return taps
