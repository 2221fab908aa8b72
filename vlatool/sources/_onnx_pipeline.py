"""Several ONNX graphs that feed each other as one graph, with what goes back as memory; and the same run in a chain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import SourceError, require, suggest
from vlatool.graph.nodes import rename_reads
from vlatool.graph.opsets import opset_of
from vlatool.runtime.engine import engine_class
from vlatool.sources._onnx_axes import with_opset
from vlatool.sources._onnx_files import load_onnx

BEGUN_FLAG = "begun"
"""Memory that is zero until the first inference, where a memory begins with other values than zero."""


@dataclass(frozen=True)
class Pipeline:
    """Graphs in the order in which they run; a value is named ``GRAPH/NAME``.

    Args:
        files: graph -> ONNX file.
        flows: input -> the output that it reads in the same inference.
        memories: input -> the output of the inference before.
        initial: input -> what a memory is at the beginning; zero where there is none.
        inputs: input -> its name outside.
        outputs: output -> its name outside, the action first.
    """

    files: Mapping[str, Path]
    flows: Mapping[str, str]
    memories: Mapping[str, str]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    initial: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def merge(self) -> Any:
        """Return one ``ModelProto``: inputs and outputs by their names outside, then those of the memories.

        Raises:
            SourceError: when a graph lacks a value that the pipeline names.
        """
        compose, helper = require("onnx.compose", "build"), require("onnx.helper", "build")
        models = {name: _inlined(load_onnx(file)) for name, file in self.files.items()}
        opset = max(map(opset_of, models.values()))
        parts = [compose.add_prefix(with_opset(model, opset), f"{name}/") for name, model in models.items()]
        taken = {value.name: value for part in parts for value in part.graph.input}
        given = {value.name: value for part in parts for value in part.graph.output}
        self._check(taken, given)
        nodes, weights = [], []
        for part in parts:
            for target, source in self.flows.items():
                rename_reads(part.graph, target, source)
            nodes.extend(part.graph.node)
            weights.extend(part.graph.initializer)
        graph = helper.make_graph(nodes, "pipeline", [], [], weights)
        self._put_ends(graph, taken, given)
        domains = {entry.domain: entry for part in parts for entry in part.opset_import}
        ir_version = max(part.ir_version for part in parts)
        return helper.make_model(graph, opset_imports=list(domains.values()), ir_version=ir_version)

    @property
    def feedback(self) -> dict[str, str]:
        """Memory as an input of the merged graph -> as an output of it."""
        feedback = {target: f"{target}/next" for target in self.memories}
        return feedback | ({BEGUN_FLAG: f"{BEGUN_FLAG}/next"} if self.initial else {})

    def _check(self, taken: Mapping[str, Any], given: Mapping[str, Any]) -> None:
        for what, names, known in (
            ("input", {*self.flows, *self.memories, *self.inputs}, taken),
            ("output", {*self.flows.values(), *self.memories.values(), *self.outputs}, given),
        ):
            for name in sorted(names - known.keys()):
                raise SourceError(
                    f"The pipeline names the {what} '{name}', which its graph lacks; {suggest(name, sorted(known))}.",
                    "export the bundle again: its YAML and its graphs do not belong together",
                )
        unfed = sorted(taken.keys() - {*self.flows, *self.memories, *self.inputs})
        if unfed:
            raise SourceError(
                f"Nothing feeds {', '.join(unfed)} in the pipeline.", "export the bundle again where it was made"
            )

    def _put_ends(self, graph: Any, taken: Mapping[str, Any], given: Mapping[str, Any]) -> None:
        helper, numpy_helper = require("onnx.helper", "build"), require("onnx.numpy_helper", "build")
        first = []
        for source, name in self.inputs.items():
            rename_reads(graph, source, name)
            graph.input.append(_named(taken[source], name))
        for source, name in self.outputs.items():
            graph.node.append(helper.make_node("Identity", [source], [name], f"{name}/Identity"))
            graph.output.append(_named(given[source], name))
        for target, source in self.memories.items():
            graph.input.append(taken[target])
            graph.node.append(helper.make_node("Identity", [source], [self.feedback[target]], f"{target}/keep"))
            graph.output.append(_named(given[source], self.feedback[target]))
            if target in self.initial:
                rename_reads(graph, target, f"{target}/held")
                graph.initializer.append(numpy_helper.from_array(self.initial[target], f"{target}/initial"))
                held = [f"{BEGUN_FLAG}/true", target, f"{target}/initial"]
                first.append(helper.make_node("Where", held, [f"{target}/held"], f"{target}/begin"))
        if self.initial:
            one = require("onnx", "build").TensorProto.FLOAT
            graph.input.append(helper.make_tensor_value_info(BEGUN_FLAG, one, [1]))
            graph.output.append(helper.make_tensor_value_info(self.feedback[BEGUN_FLAG], one, [1]))
            cast = helper.make_node("Cast", [BEGUN_FLAG], [f"{BEGUN_FLAG}/true"], f"{BEGUN_FLAG}/Cast", to=9)
            graph.initializer.append(numpy_helper.from_array(np.ones(1, np.float32), f"{BEGUN_FLAG}/one"))
            nexts = helper.make_node(
                "Max", [BEGUN_FLAG, f"{BEGUN_FLAG}/one"], [self.feedback[BEGUN_FLAG]], f"{BEGUN_FLAG}/Max"
            )
            nodes = [cast, *first, *graph.node, nexts]
            del graph.node[:]
            graph.node.extend(nodes)


class Chain:
    """The graphs of a pipeline, each in a session of its own, behind the interface of one session."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._sessions = {name: engine_class()(file, threads=1) for name, file in pipeline.files.items()}
        models = {name: load_onnx(file) for name, file in pipeline.files.items()}
        self._shapes = {
            f"{name}/{value.name}": [axis.dim_value for axis in value.type.tensor_type.shape.dim]
            for name, model in models.items()
            for value in model.graph.input
        }
        self._takes = {name: [value.name for value in model.graph.input] for name, model in models.items()}

    def run(self, feeds: Mapping[str, Any]) -> dict[str, Any]:
        """Run the graphs one after the other on numpy arrays."""
        pipeline, values = self._pipeline, dict[str, Any]()
        begun = not pipeline.initial or bool(np.any(feeds[BEGUN_FLAG]))
        for target in pipeline.memories:
            fresh = not begun and target in pipeline.initial
            values[target] = pipeline.initial[target] if fresh else feeds[target]
        values |= {source: feeds[name] for source, name in pipeline.inputs.items()}
        for name, session in self._sessions.items():
            keys = [f"{name}/{word}" for word in self._takes[name]]
            taken = {key: values[pipeline.flows.get(key, key)] for key in keys}
            shaped = {key.partition("/")[2]: self._shaped(key, value) for key, value in taken.items()}
            values |= {f"{name}/{word}": value for word, value in session.run(shaped).items()}
        given = {name: values[source] for source, name in pipeline.outputs.items()}
        given |= {pipeline.feedback[target]: values[source] for target, source in pipeline.memories.items()}
        return given | ({pipeline.feedback[BEGUN_FLAG]: np.ones(1, np.float32)} if pipeline.initial else {})

    def _shaped(self, key: str, value: Any) -> Any:
        """Return a value with the axes of the file: a batch axis may have been put in front of it."""
        shape = self._shapes[key]
        return np.reshape(value, shape) if all(shape) and np.size(value) == np.prod(shape, dtype=int) else value


def in_order(graphs: Sequence[str], flows: Mapping[str, str]) -> list[str]:
    """Return graphs so that each comes after those that it reads.

    Raises:
        SourceError: when two read each other.
    """
    reads = {name: {source.partition("/")[0] for target, source in flows.items() if target.partition("/")[0] == name}
             for name in graphs}  # fmt: skip
    ordered: list[str] = []
    while len(ordered) < len(graphs):
        ready = [name for name in graphs if name not in ordered and reads[name] <= {*ordered}]
        if not ready:
            rest = ", ".join(name for name in graphs if name not in ordered)
            raise SourceError(f"The graphs {rest} read each other.", "export the bundle again where it was made")
        ordered += ready
    return ordered


def _inlined(model: Any) -> Any:
    return require("onnx.inliner", "build").inline_local_functions(model) if model.functions else model


def _named(value: Any, name: str) -> Any:
    copy = type(value)()
    copy.CopyFrom(value)
    copy.name = name
    return copy
