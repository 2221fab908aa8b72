"""Run a policy on recorded observations while chosen values inside its graphs are looked at; none of them is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.data import Encoded, Moment
from vlatool.errors import DataError, GraphError, require
from vlatool.graph.files import write_beside
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.machine.risky import risky
from vlatool.runtime.contract import off_the_robot
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class
from vlatool.runtime.graph_files import open_graph
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.stage.base import Context

SAMPLE_OR_POLICY = "remove that sample from the recording, or correct the policy where it may come"
SAMPLE = "Calibration sample"


class Watcher:
    """A session of a graph with further outputs, which the program does not see.

    Args:
        path: The graph; large weights stay where they are.
        copy: Where it is written with the further outputs.
        show: Adds them.
    """

    def __init__(self, path: Path, copy: Path, show: Callable[[OnnxGraph], None]) -> None:
        graph = OnnxGraph(require("onnx", "build").load(str(path), load_external_data=False))
        self.sample = 0
        self.counts = True
        self._outputs = [value.name for value in graph.graph.output]
        show(graph)
        self._about = f"the graph '{path.stem}' with further outputs"
        with risky(engine_class(), f"opened {self._about}"):
            self._session = engine_class()(write_beside(graph.model, path, copy), 1)

    def watch(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Look at what one run was fed and gave."""
        raise NotImplementedError

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run, look at the values, return the graph's own outputs."""
        with risky(engine_class(), f"ran {self._about}"):
            values = self._session.run(feeds)
        if self.counts:
            self.watch(feeds, values)
        return {name: values[name] for name in self._outputs}


class _Passing(ObservationEncoder):
    """An encoder that hands on what is encoded already."""

    def __init__(self, encode: ObservationEncoder) -> None:
        self.names, self._encode = encode.names, encode

    def __call__(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Encode an observation, as ``ObservationEncoder`` does, where that is to be done."""
        return observation if isinstance(observation, Encoded) else self._encode(observation)


def run_watched(
    bundle: Bundle,
    watchers: Mapping[str, Watcher],
    observations: Iterable[Mapping[str, Any] | Moment],
    context: Context,
    what: str,
    numbers: Sequence[int] = (),
) -> None:
    """Run a policy whose graphs are watched.

    Args:
        bundle: A float32 bundle.
        watchers: Graph name -> session; graphs without one run as they are.
        observations: Raw ones, or as the graphs take them (``Encoded``), consumed one at a time. Of moments, those that
            do not count are not watched, and where an episode begins the policy forgets what it kept.
        context: For progress.
        what: Is being done, before the words "sample 3".
        numbers: What messages call the observations: their places in the recording; counted from 0 when empty.

    Raises:
        DataError: when an observation does not fit the spec, or a watcher refuses a value; names the sample.
    """
    graphs = bundle.manifest.graphs
    others = {name: open_graph(bundle, graphs[name], engine_class(), 1) for name in graphs if name not in watchers}
    policy = Policy(bundle, Program(bundle.manifest.program, {**others, **watchers}, seed=0), DEFAULT_ENGINE)
    policy.encode = _Passing(policy.encode)
    for place, each in enumerate(observations):
        moment = each if isinstance(each, Moment) else Moment(each, numbers[place] if numbers else place)
        number = moment.number
        if place % 8 == 0:
            context.tell(f"{what} sample {number}", place / len(numbers) if place < len(numbers) else None)
        for watcher in watchers.values():
            watcher.sample, watcher.counts = number, moment.counts
        if moment.begins:
            policy.reset(number)
        try:
            with off_the_robot("what was recorded", SAMPLE_OR_POLICY):
                policy.infer(moment.observation)
        except (GraphError, DataError) as error:
            if error.message.startswith(SAMPLE):
                raise
            raise DataError(f"{SAMPLE} {number}: {error.message}", error.fix) from error
