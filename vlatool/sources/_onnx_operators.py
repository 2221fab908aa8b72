"""Operators of an ONNX file that no engine has, and versions that are too new, by name and place."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vlatool.errors import SourceError, require
from vlatool.files.printable import one_line
from vlatool.graph.nodes import inner_nodes

KNOWN_DOMAINS = (
    "",
    "ai.onnx",
    "ai.onnx.ml",
    "com.microsoft",
    "com.microsoft.nchwc",
    "com.ms.internal.nhwc",
    "ai.onnx.preview",
)
"""Domains whose operators ONNX Runtime has."""
OF_ONNX_RUNTIME = (
    "SimplifiedLayerNormalization", "Affine", "ParametricSoftplus", "ScaledTanh", "ImageScaler", "Crop", "DynamicSlice",
    "GivenTensorFill", "Scale", "GroupNorm", "FusedMatMul",
)  # fmt: skip
"""Operators that ONNX Runtime has in the domain of ONNX, which onnx itself lacks."""
REMEDIES = {
    "ai.onnx.contrib": "cut off the steps of onnxruntime-extensions (texts, decoding of pictures): the robot does them",
    "com.microsoft.extensions": "cut off the steps of onnxruntime-extensions: the robot does them",
    "org.pytorch.aten": "export it again without operator_export_type=ONNX_FALLTHROUGH or ONNX_ATEN_FALLBACK",
    "mmdeploy": "export it with mmdeploy for the backend onnxruntime without custom operators, or replace that layer",
}
REPLACE = "replace it by operators of ONNX where the file is made"


def refuse_operators(model: Any, path: Path) -> None:
    """Refuse an opset or a format that this onnx does not know, and operators that no engine has.

    Raises:
        SourceError: naming the version, or the node, its operator and its domain.
    """
    onnx = require("onnx", "build")
    newest = onnx.defs.onnx_opset_version()
    for entry in model.opset_import:
        if entry.domain in ("", "ai.onnx") and entry.version > newest:
            raise SourceError(
                f"{path} has opset {entry.version}; onnx {onnx.__version__} knows those up to {newest}.",
                "export it with an older one where it is made (opset_version=18), or upgrade onnx and onnxruntime",
            )
    if model.ir_version > onnx.IR_VERSION:
        raise SourceError(
            f"{path} has the format (ir_version) {model.ir_version}; onnx {onnx.__version__} knows those up to "
            f"{onnx.IR_VERSION}.",
            "export it with an older onnx where it is made, or upgrade onnx and onnxruntime",
        )
    local = {(function.domain, function.name) for function in model.functions}
    for node in _nodes(model):
        if (node.domain, node.op_type) in local or _is_known(node):
            continue
        kind, where = one_line(node.op_type, 60), one_line(node.name or ", ".join(node.output), 100)
        domain = f" of the domain '{one_line(node.domain, 60)}'" if node.domain else ""
        raise SourceError(
            f"{path} has the operator {kind}{domain} at '{where}', which no engine has.",
            REMEDIES.get(node.domain, REPLACE),
        )


def _nodes(model: Any) -> Iterator[Any]:
    for graph in (model.graph, *model.functions):
        for node in graph.node:
            yield node
            yield from inner_nodes(node)


def _is_known(node: Any) -> bool:
    """Return whether ONNX Runtime may have an operator: of its own domains it says itself which it lacks."""
    if node.domain not in ("", "ai.onnx", "ai.onnx.ml"):
        return node.domain in KNOWN_DOMAINS
    domain = node.domain if node.domain == "ai.onnx.ml" else ""
    return node.op_type in OF_ONNX_RUNTIME or bool(require("onnx", "build").defs.has(node.op_type, domain))
