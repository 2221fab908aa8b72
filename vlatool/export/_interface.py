"""What somebody who runs the files of another engine needs to know beside them, as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.bundle.manifest import Manifest
from vlatool.errors import require

HOW = (
    "The observation becomes inputs as spec.inputs says (image, normalisation with statistics in assets, tokenizer); "
    "the graphs run in the order of the program; outputs become actions as spec.outputs says: "
    "docs/guides/other-engines.md."
)
LAYOUTS = {"chw": "NCHW", "hwc": "NHWC"}


def write_interface(path: Path, source: Bundle, graphs: Mapping[str, Mapping[str, Any]]) -> None:
    """Write which files there are, what each graph takes and gives, in which order they run, and what values mean.

    Args:
        graphs: graph name -> what is known of it, as ``graph_entry`` returns it.
    """
    manifest = Manifest.to_dict(source.manifest)
    content = {
        "policy": source.manifest.name, "version": source.manifest.version, "made_from": source.hash,
        "graphs": graphs, "program": manifest["program"], "spec": manifest["spec"],
        "how": HOW,
    }  # fmt: skip
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def graph_entry(source: Bundle, name: str, original: Path, files: Mapping[str, Path], root: Path) -> dict[str, Any]:
    """Return what is to be known of a graph: its files with their hashes, its inputs and outputs.

    Args:
        original: its ONNX file.
        files: role (``model``, ``weights``) -> file.
        root: directory that the files are named relative to.
    """
    onnx = require("onnx", "build")
    model = onnx.load(str(original), load_external_data=False)
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in constants]
    return {
        "files": {
            role: {"file": file.relative_to(root).as_posix(), "sha256": hash_file(file), "bytes": file.stat().st_size}
            for role, file in files.items()
        },
        "inputs": [_port(value) | _layout(source, name, value.name) for value in inputs],
        "outputs": [_port(value) for value in model.graph.output],
    }


def _port(value: Any) -> dict[str, Any]:
    helper = require("onnx.helper", "build")
    kind = value.type.tensor_type
    axes = [axis.dim_param or axis.dim_value for axis in kind.shape.dim]
    return {"name": value.name, "shape": axes, "dtype": str(helper.tensor_dtype_to_np_dtype(kind.elem_type))}


def _layout(source: Bundle, graph: str, feed: str) -> dict[str, str]:
    """Return which input of the policy a feed is, and its layout where that is an image."""
    spec = {tensor.name: tensor for tensor in source.manifest.spec.inputs}
    values = {step.feeds[feed] for step in source.manifest.program if step.graph == graph and feed in step.feeds}
    tensor = next((spec[value] for value in values if value in spec), None)
    if tensor is None:
        return {}
    image = {"layout": LAYOUTS[tensor.image.layout]} if tensor.image is not None else {}
    return {"spec_input": tensor.name, **image}
