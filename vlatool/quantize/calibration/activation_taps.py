"""Run a policy on recorded observations and observe selected values inside its graphs, without storing them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment
from vlatool.errors import DataError, GraphError, require
from vlatool.graph.files import write_linked
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.contract import off_the_robot
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class
from vlatool.runtime.graph_files import open_graph
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.stage.base import Context

SAMPLE_FIX = "remove that sample from the recording, or correct the policy where it may come"
SAMPLE_LABEL = "Calibration sample"


class ActivationTap:
    """A session of a graph with additional outputs, which are hidden from the program.

    Args:
        path: File of the graph; large weights stay in their files.
        copy: Path of the copy with additional outputs.
    """

    def __init__(self, path: Path, copy: Path, add_outputs: Callable[[OnnxGraph], None]) -> None:
        graph = OnnxGraph(require("onnx", "build").load(str(path), load_external_data=False))
        self.sample = 0
        self.observing = True
        self._outputs = [value.name for value in graph.graph.output]
        add_outputs(graph)
        self._description = f"the graph '{path.stem}' with additional outputs"
        with engine_call(engine_class(), f"opened {self._description}"):
            self._session = engine_class()(write_linked(graph.model, path, copy), 1)

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


def run_with_taps(
    bundle: Bundle,
    taps: Mapping[str, ActivationTap],
    observations: Iterable[Mapping[str, Any] | Moment],
    context: Context,
    activity: str,
    numbers: Sequence[int] = (),
) -> None:
    """Run a policy with taps on its graphs.

    Args:
        taps: Graph name -> session; graphs without one run unchanged.
        observations: Raw ones, or encoded for the graphs (``Encoded``), consumed one at a time. Moments that do not
            count are not observed, and the policy is reset where an episode begins.
        activity: Description of the work in progress messages, before the words "sample 3".
        numbers: Indices of the observations in the recording, for messages; counted from 0 when empty.

    Raises:
        DataError: when an observation does not fit the spec, or a tap refuses a value; names the sample.
    """
    graphs = bundle.manifest.graphs
    others = {name: open_graph(bundle, graphs[name], engine_class(), 1) for name in graphs if name not in taps}
    policy = Policy(bundle, Program(bundle.manifest.program, {**others, **taps}, seed=0), DEFAULT_ENGINE)
    for index, each in enumerate(observations):
        moment = each if isinstance(each, Moment) else Moment(each, numbers[index] if numbers else index)
        number = moment.number
        if index % 8 == 0:
            context.progress(f"{activity} sample {number}", index / len(numbers) if index < len(numbers) else None)
        for tap in taps.values():
            tap.sample, tap.observing = number, moment.counts
        if moment.begins:
            policy.reset(number)
        try:
            with off_the_robot("what was recorded", SAMPLE_FIX):
                policy.infer(moment.observation)
        except (GraphError, DataError) as error:
            if error.message.startswith(SAMPLE_LABEL):
                raise
            raise DataError(f"{SAMPLE_LABEL} {number}: {error.message}", error.fix) from error
