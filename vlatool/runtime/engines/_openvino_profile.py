"""The profile of OpenVINO: the time of each node, and what it computes in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import GraphError
from vlatool.machine.engine_calls import REMEDY
from vlatool.runtime.engine import BFLOAT16, FLOAT32, INT8, MOVES, MOVING, QUANTIZES, QUANTIZING, Node, NodeRun
from vlatool.runtime.engines._openvino_core import openvino_core
from vlatool.runtime.engines._products import Shape, macs


class OpenvinoProfiled:
    """OpenVINO counts the time of every node of a compiled model on request."""

    def __init__(self, path: Path, compiled: Callable[[Any, Any], Any]) -> None:
        try:
            core = openvino_core()
            model = core.read_model(str(path))
            known = {node.get_friendly_name(): str(node.get_type_name()) for node in model.get_ops()}
            self._compiled = compiled(core, model)
            self._request = self._compiled.create_infer_request()
            self._fused = fused_names(self._compiled, known)
        except Exception as error:  # the seam: every exception type of OpenVINO becomes ours
            raise GraphError(
                f"OpenVINO cannot profile {path.name}: {str(error)[:200]}", REMEDY.format(package="openvino")
            ) from error
        self._outputs = [output.get_any_name() for output in self._compiled.outputs]
        self._runs: list[dict[Node, float]] = []

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        self._request.infer(feeds)
        spent: dict[Node, float] = {}
        for item in self._request.profiling_info:
            if str(item.status).endswith("EXECUTED"):
                named = self._fused.get(item.node_name, (item.node_name, item.node_type))
                key = (*named, item.exec_type)
                spent[key] = spent.get(key, 0.0) + item.real_time.total_seconds() * 1e6
        self._runs.append(spent)
        outputs = enumerate(self._outputs)
        return {name: np.array(self._request.get_output_tensor(index).data) for index, name in outputs}

    def times(self) -> list[dict[Node, float]]:
        return self._runs


def fused_names(compiled: Any, known: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return subgraph -> name of the node of the file that it mostly is, and its kind: with its product, if it has one.

    OpenVINO fuses small operators, and whole attentions, into a Subgraph that it names after its last one, which is
    often the quantization of what it gives.

    Args:
        known: Name of each node as it was read -> its operator type.
    """
    names: dict[str, tuple[str, str]] = {}
    for node in compiled.get_runtime_model().get_ops():
        about = node.get_rt_info()
        if str(about["layerType"].astype(str)) != "Subgraph":
            continue
        inside = [name for name in str(about["originalLayersNames"].astype(str)).split(",") if name in known]
        computing = [name for name in inside if not _is_quantizer(name) and known[name] != "FakeQuantize"]
        product = next((name for name in computing if known[name] == "MatMul"), "")
        if computing:
            names[node.get_friendly_name()] = (product or computing[0], "Subgraph (MatMul)" if product else "Subgraph")
    return names


NOT_RUN = ("Const", "Input", "Output")
"""Types of a compiled model's nodes that are values."""


def products(model: Any) -> dict[str, int]:
    """Return name -> multiply-accumulates of the matrix products of a model as it was read, where shapes are known."""
    found = {}
    for node in model.get_ops():
        kind = str(node.get_type_name())
        inputs, outputs = _shapes(node.inputs()), _shapes(node.outputs())
        count = macs(kind, inputs, outputs, {}, "") if inputs and outputs else None
        if count:
            found[node.get_friendly_name()] = count
    return found


def node_runs(compiled: Any, known: Mapping[str, int]) -> list[NodeRun]:
    """Return the nodes of a compiled model, each as it runs once.

    Args:
        known: Multiply-accumulates of the products of the model as it was read (``products``). OpenVINO merges those of
            an attention into a subgraph, and names the last one there (2026.4): those that no node accounts for are
            shared out among such subgraphs.
    """
    devices = ", ".join(compiled.get_property("EXECUTION_DEVICES"))
    runs: list[NodeRun] = []
    merged: dict[int, int] = {}
    for node in compiled.get_runtime_model().get_ops():
        about = {key: str(value.astype(str)) for key, value in node.get_rt_info().items()}
        kind, name = about["layerType"], node.get_friendly_name()
        if kind in NOT_RUN:
            continue
        inputs, outputs = _shapes(node.inputs()), _shapes(node.outputs())
        own = macs(kind, inputs, outputs, {}, name) if inputs and outputs else None
        if kind == "Subgraph" and (inside := sum(known.get(one, 0) for one in _merged_names(about))):
            own = merged[len(runs)] = inside
        computed = precision(("", kind, about.get("primitiveType", "")))  # a product is named after its quantizer
        runs.append(NodeRun(name, kind, devices, computed, own))
    missing = sum(known.values()) - sum(run.macs or 0 for run in runs)
    for index, inside in merged.items():
        runs[index] = replace(runs[index], macs=inside + max(0, missing) * inside // sum(merged.values()))
    return runs


def _merged_names(about: Mapping[str, str]) -> set[str]:
    return set(about.get("originalLayersNames", "").split(","))


def _shapes(ports: Iterable[Any]) -> list[Shape]:
    """Return the shapes of some ports; nothing where one is not fixed."""
    shapes = [port.get_partial_shape() for port in ports]
    return [] if any(shape.is_dynamic for shape in shapes) else [tuple(shape.to_shape()) for shape in shapes]


def _is_quantizer(name: str) -> bool:
    return "quantize" in name.lower()


def precision(node: Node) -> str:
    """Return what a node computes in."""
    name, kind, kernel = node
    if kind in MOVES:
        return MOVING
    if kind in QUANTIZES or (kind == "Subgraph" and _is_quantizer(name)):
        return QUANTIZING
    ending = kernel.rpartition("_")[2].lower()
    return {"i8": INT8, "u8": INT8, "bf16": BFLOAT16, "f32": FLOAT32, "fp32": FLOAT32, "f16": "float16"}.get(
        ending, ending
    )
