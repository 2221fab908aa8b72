"""The identity of a policy: one hash over all that decides how a robot behaves with it, and over nothing else."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from vlatool.bundle.bundle import ASSETS, Bundle
from vlatool.bundle.manifest import Graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.files.messages import to_json
from vlatool.files.verified_read import open_inside
from vlatool.runtime.external_data import OpenFile, external_files
from vlatool.runtime.graph_files import recorded_files
from vlatool.runtime.statistics import load_normaliser

FORMAT = 1
"""Version of what is hashed: a change of it changes every identity."""
FILE_FIELDS = ("statistics", "tokenizer")
"""Fields of a tensor that name files: what the files say is hashed, not their names."""
ROWS = ("offset", "scale", "inverse_scale")
"""Fields of a normaliser that its values follow from."""
NO_BEHAVIOUR = ("data/", "golden/", f"{ASSETS}/")
"""Prefixes of the files of a source bundle that hold no weights; assets are hashed with the tensors that name them."""


def policy_identity(bundle: Bundle) -> str:
    """Return ``sha256:...`` of weights, resolved statistics, preprocessing, program and controller convention.

    Two bundles that differ in it may behave differently; copies, and bundles that differ in name, version, description,
    origin or reports, do not. The engine and the machine are not part of it.

    Args:
        bundle: a verified bundle: what its manifest records is taken as the content of its files.

    Raises:
        BundleError: when a file of it is missing or changed.
        SpecError: when statistics are missing or do not fit.
        GraphError: when a graph is not an ONNX model.
    """
    content = {
        "format": FORMAT,
        "spec": _spec(bundle),
        "program": to_json(bundle.manifest.program, defaults=False),
        "weights": _weights(bundle),
    }
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def _spec(bundle: Bundle) -> dict[str, Any]:
    """Return the spec with every field that is not a default, as the controller and the encoder take it."""
    spec: PolicySpec = bundle.manifest.spec
    plain = spec.to_dict()
    plain["execute"] = spec.executed_actions
    for side, tensors in (("inputs", spec.inputs), ("outputs", spec.outputs)):
        plain[side] = [_tensor(tensor, bundle) for tensor in tensors]
    return _as_floats(plain)  # type: ignore[no-any-return]


def _tensor(tensor: TensorSpec, bundle: Bundle) -> dict[str, Any]:
    """Return a tensor's fields, the content of its files in the place of their names."""
    plain = {name: value for name, value in tensor.to_dict().items() if name not in FILE_FIELDS}
    plain["unit"] = tensor.units() or tensor.unit
    normaliser = load_normaliser(tensor, bundle)
    if normaliser is not None:
        rows = {name: getattr(normaliser, name) for name in ROWS}
        plain["statistics"] = {name: row.tolist() for name, row in rows.items() if row is not None}
    statistics = tensor.statistics.partition("#")[0]
    others = [file for file in tensor.assets() if file != statistics]
    plain["files"] = [_sha256(bundle, f"{ASSETS}/{file}") for file in others]
    return plain


def _weights(bundle: Bundle) -> dict[str, Any]:
    """Return the hashes of the graphs and of the weights beside them; of a source bundle, those of code and weights."""
    manifest = bundle.manifest
    if manifest.graphs:
        return {name: _graph(bundle, graph) for name, graph in manifest.graphs.items()}
    files = {name: record.sha256 for name, record in manifest.files.items() if not name.startswith(NO_BEHAVIOUR)}
    return {"source": manifest.source, "files": files}


def _graph(bundle: Bundle, graph: Graph) -> dict[str, Any]:
    with open_inside(bundle.path, graph.file) as handle:
        beside = recorded_files(bundle, graph.file, external_files(OpenFile(handle)))
    return {"files": [_sha256(bundle, file) for file in (graph.file, *beside)], "compute": graph.compute}


def _sha256(bundle: Bundle, file: str) -> str:
    bundle.file(file)  # refuses what the manifest does not record
    return bundle.manifest.files[file].sha256


def _as_floats(value: Any) -> Any:
    """Return JSON in which 80 and 80.0 are the same number."""
    if isinstance(value, dict):
        return {name: _as_floats(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_floats(item) for item in value]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value
