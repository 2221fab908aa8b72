"""The profile of OpenVINO: the time of each node, and what it computes in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import GraphError
from vlatool.machine.engine_calls import REMEDY
from vlatool.runtime.engine import BFLOAT16, FLOAT32, INT8, MOVES, MOVING, QUANTIZES, QUANTIZING, Node
from vlatool.runtime.engines._openvino_core import openvino_core


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
