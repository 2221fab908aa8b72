"""Workload files: in the cache, or next to a policy."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import OutputError
from vlatool.files.user_files import atomic_file
from vlatool.graph.workload import GraphWorkload, Workload
from vlatool.machine.version import VERSION

LAYOUT_VERSION = 4
"""Version of the file format."""
COUNTS = ("layers", "weights", "read_again", "activations", "weight_bytes", "activation_bytes", "peak_bytes")


def digest(bundle: Bundle) -> str:
    """Return the SHA-256 of everything that a count of a source depends on: code, weights, arguments, spec and program.

    vlatool's own samples are identified by its version.
    """
    manifest = bundle.manifest.to_dict()
    depends = {key: manifest.get(key) for key in ("source", "spec", "program", "parts")}
    text = json.dumps({**depends, "vlatool": VERSION}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def read_workload(file: Path, of: str = "") -> Workload | None:
    """Return the workload of a file; None when it is missing, damaged or has another ``digest`` than ``of``."""
    data = _content(file)
    return from_values(data) if data.get("digest", "") == of else None


def _content(file: Path) -> dict[str, Any]:
    """Return the content of a JSON file; empty when it is missing, damaged or not an object."""
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def is_workload(file: Path) -> bool:
    """Return whether a file is a workload file, including earlier formats, which are no longer read."""
    data = _content(file)
    if not isinstance(data.get("layout"), int):
        return False
    return from_values(data) is not None if data["layout"] >= LAYOUT_VERSION else isinstance(data.get("graphs"), dict)


def from_values(data: Any) -> Workload | None:
    """Return the workload from the result of ``to_values``; None for anything else."""
    if not isinstance(data, dict) or data.get("layout") != LAYOUT_VERSION:
        return None
    graphs = {}
    try:
        for name, fields in data["graphs"].items():
            fields["traits"], fields["unknown"] = frozenset(fields["traits"]), tuple(fields["unknown"])
            fields["parts"] = {part: tuple(numbers) for part, numbers in fields["parts"].items()}
            counts = [fields[key] for key in COUNTS] + list(fields["macs"].values())
            counts += [number for part in fields["parts"].values() for number in part]
            fours = all(len(part) == 4 for part in fields["parts"].values())
            if not fours or not all(isinstance(count, int) and count >= 0 for count in counts):
                return None
            graphs[name] = GraphWorkload(**fields)
        return Workload(graphs, {name: int(data["runs"][name]) for name in data["runs"] if name in graphs})
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def refuse_foreign_file(file: Path) -> None:
    """Refuse, with OutputError, a file that ``write_workload`` did not write."""
    if not os.path.lexists(file):
        return
    if file.is_symlink() or set(_content(file)) != {"layout", "digest", "graphs", "runs"}:
        raise OutputError(f"{file} was not written by vlatool.", "move it away yourself")


def write_workload(file: Path, work: Workload, of: str = "") -> None:
    """Write a workload for ``read_workload``; raises OSError when the file cannot be written."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(file) as draft:
        data = {**to_values(work), "digest": of}
        draft.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def to_values(work: Workload) -> dict[str, Any]:
    """Return a workload as JSON values."""
    graphs: dict[str, Any] = {}
    for name, graph in work.graphs.items():
        fields = dataclasses.asdict(graph)
        graphs[name] = {**fields, "traits": sorted(graph.traits), "macs": dict(graph.macs)}
    return {"layout": LAYOUT_VERSION, "graphs": graphs, "runs": dict(work.runs)}
