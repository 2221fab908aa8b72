"""Compare two bundles file by file, and say in words how files differ."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.errors import DataError, require
from vlatool.files.npz import open_npz

MAX_NAMED = 5
"""How many names a sentence lists before it counts the rest."""
BLOCK = 1 << 20


@dataclass(frozen=True)
class FileMatch:
    """One file of a bundle beside the same file of another.

    Args:
        file: path inside the bundles.
        bytes: size in the first bundle; in the second where the first lacks the file.
        identical: whether every byte is the same (of the manifest: every field that is compared).
        why: how the files differ, a sentence part; empty when they are identical.
    """

    file: str
    bytes: int
    identical: bool
    why: str = ""


def compare_bundles(first: Bundle, second: Bundle, leave_out: Iterable[str] = ()) -> tuple[FileMatch, ...]:
    """Compare every file that one of the manifests records, then the manifests themselves.

    Args:
        first: bundle that is checked; sentences call it ``recorded``.
        second: bundle that was made again; sentences call it ``rebuilt``.
        leave_out: top-level fields of the manifest that are not compared.

    Returns:
        One entry for each file, sorted by name, the manifest last.
    """
    names = sorted({*first.manifest.files, *second.manifest.files})
    return (*(_compare(first, second, name) for name in names), _compare_manifests(first, second, set(leave_out)))


def _compare(first: Bundle, second: Bundle, name: str) -> FileMatch:
    one, two = first.manifest.files.get(name), second.manifest.files.get(name)
    if one is None or two is None:
        size = (one or two).bytes if one or two else 0  # type: ignore[union-attr]
        return FileMatch(name, size, False, f"{'only' if one is None else 'not'} in the rebuilt bundle")
    if same_bytes(first.path / name, second.path / name):
        return FileMatch(name, one.bytes, True)
    return FileMatch(name, one.bytes, False, explain(first.path / name, second.path / name))


def _compare_manifests(first: Bundle, second: Bundle, leave_out: set[str]) -> FileMatch:
    path = first.path / MANIFEST
    size = path.stat().st_size
    if not leave_out and same_bytes(path, second.path / MANIFEST):
        return FileMatch(MANIFEST, size, True)
    one, two = (_fields(bundle, leave_out) for bundle in (first, second))
    if leave_out and json.dumps(one) == json.dumps(two):
        return FileMatch(MANIFEST, size, True)
    found = list(_changes(one, two, ""))
    return FileMatch(MANIFEST, size, False, name_list(found) if found else "the same fields in another order or layout")


def _fields(bundle: Bundle, leave_out: set[str]) -> dict[str, Any]:
    data = json.loads((bundle.path / MANIFEST).read_text(encoding="utf-8"))
    return {name: value for name, value in data.items() if name not in leave_out}


def _changes(one: Any, two: Any, where: str) -> Iterator[str]:
    """Yield ``field: A recorded, B rebuilt`` for each leaf that differs."""
    if isinstance(one, Mapping) and isinstance(two, Mapping):
        for name in dict.fromkeys([*one, *two]):
            yield from _changes(one.get(name), two.get(name), f"{where}.{name}" if where else name)
    elif isinstance(one, list) and isinstance(two, list) and len(one) == len(two):
        for index, (left, right) in enumerate(zip(one, two, strict=True)):
            yield from _changes(left, right, f"{where}[{index}]")
    elif one != two:
        yield f"{where}: {_short(one)} recorded, {_short(two)} rebuilt"


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else f"{text[:37]}..."


def same_bytes(one: Path, two: Path) -> bool:
    """Compare two files byte by byte, a block at a time."""
    return one.stat().st_size == two.stat().st_size and _first_difference(one, two) == one.stat().st_size


def explain(one: Path, two: Path) -> str:
    """Say how two files that are not identical differ.

    Returns:
        For ONNX graphs the initializers and nodes, for ``.npz`` the arrays, else the first byte that differs.
    """
    special: dict[str, Callable[[Path, Path], str]] = {".onnx": _explain_onnx, ".npz": _explain_npz}
    if one.suffix in special:
        try:
            said = special[one.suffix](one, two)
        except (DataError, ValueError, OSError, KeyError):
            said = ""
        if said:
            return said
    sizes = f"{one.stat().st_size} bytes recorded, {two.stat().st_size} rebuilt"
    return f"first difference at byte {_first_difference(one, two)} ({sizes})"


def _first_difference(one: Path, two: Path) -> int:
    """Return the position of the first byte that differs, or at which one file ends."""
    position = 0
    with one.open("rb") as left, two.open("rb") as right:
        while True:
            a, b = left.read(BLOCK), right.read(BLOCK)
            if a != b or not a:
                pairs = enumerate(zip(a, b, strict=False))
                return position + next((index for index, (x, y) in pairs if x != y), min(len(a), len(b)))
            position += len(a)


def _explain_npz(one: Path, two: Path) -> str:
    a, b = open_npz(one, "golden_bytes"), open_npz(two, "golden_bytes")
    said = []
    for name in sorted({*a, *b}):
        if name not in a or name not in b:
            said.append(f"array {name} {'only rebuilt' if name not in a else 'only recorded'}")
        elif a[name].shape != b[name].shape or a[name].dtype != b[name].dtype:
            shapes = f"{a[name].dtype}{list(a[name].shape)} recorded, {b[name].dtype}{list(b[name].shape)} rebuilt"
            said.append(f"array {name} {shapes}")
        elif a[name].tobytes() != b[name].tobytes():
            numbers = a[name].dtype.kind in "fiub"
            largest = np.max(np.abs(a[name].astype(np.float64) - b[name].astype(np.float64))) if numbers else None
            said.append(f"array {name}" + ("" if largest is None else f" (largest difference {largest:.3g})"))
    return name_list(said)


def _explain_onnx(one: Path, two: Path) -> str:
    onnx = require("onnx", "build")
    try:
        first, second = onnx.load(str(one)), onnx.load(str(two))
    except Exception:  # the seam: protobuf and onnx raise many foreign types; the bytes are compared instead
        return ""
    said = _named_difference("initializer", first.graph.initializer, second.graph.initializer)
    said += _named_difference("node", first.graph.node, second.graph.node)
    for part in ("input", "output", "value_info"):
        if _serialize(getattr(first.graph, part)) != _serialize(getattr(second.graph, part)):
            said.append(f"the graph's {part}")
    for part in ("opset_import", "functions", "metadata_props"):
        if _serialize(getattr(first, part)) != _serialize(getattr(second, part)):
            said.append(part)
    for part in ("ir_version", "producer_name", "producer_version", "doc_string"):
        if getattr(first, part) != getattr(second, part):
            said.append(f"{part}: {_short(getattr(first, part))} recorded, {_short(getattr(second, part))} rebuilt")
    return "; ".join(said)


def _named_difference(kind: str, one: Any, two: Any) -> list[str]:
    """Name the initializers or nodes that are on one side only, or have another content, or another order."""
    first = {item.name or f"#{index}": item.SerializeToString(deterministic=True) for index, item in enumerate(one)}
    second = {item.name or f"#{index}": item.SerializeToString(deterministic=True) for index, item in enumerate(two)}
    groups = {
        f"{kind}s with another content": [name for name in first if name in second and first[name] != second[name]],
        f"{kind}s not rebuilt": [name for name in first if name not in second],
        f"{kind}s only rebuilt": [name for name in second if name not in first],
    }
    said = [f"{what}: {name_list(names)}" for what, names in groups.items() if names]
    if not said and list(first) != list(second):
        said = [f"the {kind}s are in another order"]
    return said


def _serialize(items: Any) -> list[bytes]:
    return [item.SerializeToString(deterministic=True) for item in items]


def name_list(names: list[str]) -> str:
    """Return the first names, and how many more there are."""
    rest = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {rest} more" if rest > 0 else "")
