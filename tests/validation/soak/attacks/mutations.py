"""Random changes to a bundle held in memory: bits, cuts, swaps, insertions, and edits of what JSON and archives say."""

from __future__ import annotations

import copy
import hashlib
import json
import random
import string
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import DIGEST, MANIFEST, digest_of
from vlatool.errors import VlatoolError
from vlatool.files.npz import open_npz
from vlatool.stage.finish import GOLDEN, save_npz

Files = dict[str, bytes]
STRANGE: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 2, 3.5, 1e-9, 1e308, 2**31, 2**62, 2**64, 10**30, 10_000_000, "", "x", "../x",
    "/etc/passwd",
    "a\0b", "\ud800", "float32", "float64", "bfloat16", "text", "openvino", [], {}, [[]], [1], [0], ["x"], {"x": 1},
    {"shape": [1 << 40]}, {"value": "x"}, "graphs/act.onnx", "statistics.json#state", [1, 1 << 28], [1, 4], [-1, 4],
)  # fmt: skip


def read(folder: Path) -> Files:
    """Return every file of a bundle by name."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def mutated(files: Files, chance: random.Random) -> Files:
    """Return a copy with one to three changes."""
    found = dict(files)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        name = chance.choice(sorted(found) or [MANIFEST])
        change = chance.choice(CHANGES)
        change(found, name, chance)
    return found


def repaired(files: Files, original: Files) -> Files:
    """Return a copy in which the attacker has hashed again what changed, as far as the manifest can be read."""
    found = dict(files)
    try:
        manifest = json.loads(found.get(MANIFEST, b""))
        for name, record in manifest["files"].items():
            content = found.get(name)
            if content is not None and content != original.get(name) and isinstance(record, dict):
                record.update(sha256=hashlib.sha256(content).hexdigest(), bytes=len(content))
        found[MANIFEST] = json.dumps(manifest).encode("utf-8", "surrogatepass")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        pass
    found[DIGEST] = digest_of(found.get(MANIFEST, b""))
    return found


def without_golden(files: Files) -> Files:
    """Return a copy whose golden check the attacker has taken away, the strongest repair of it."""
    found = dict(files)
    try:
        manifest = json.loads(found[MANIFEST])
        manifest.pop("golden", None)
        manifest["files"].pop(GOLDEN, None)
        found[MANIFEST] = json.dumps(manifest).encode("utf-8", "surrogatepass")
        found.pop(GOLDEN, None)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        pass
    return found


def _flip(files: Files, name: str, chance: random.Random) -> None:
    content = bytearray(files[name])
    for _ in range(chance.choice((1, 1, 1, 2, 8)) if content else 0):
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    files[name] = bytes(content)


def _cut(files: Files, name: str, chance: random.Random) -> None:
    files[name] = files[name][: chance.randrange(len(files[name]) + 1)]


def _drop(files: Files, name: str, chance: random.Random) -> None:
    start, end = _span(files[name], chance)
    files[name] = files[name][:start] + files[name][end:]


def _insert(files: Files, name: str, chance: random.Random) -> None:
    start, end = _span(files[name], chance)
    new = chance.choice((chance.randbytes(chance.randrange(1, 40)), bytes(9), files[name][start:end], b"[" * 2000))
    files[name] = files[name][:start] + new + files[name][start:]


def _swap_inside(files: Files, name: str, chance: random.Random) -> None:
    content = bytearray(files[name])
    if len(content) > 1:
        one, other = sorted(chance.sample(range(len(content)), 2))
        size = min(chance.choice((1, 4, 16)), other - one, len(content) - other)
        here, there = content[one : one + size], content[other : other + size]
        content[one : one + size], content[other : other + size] = there, here
    files[name] = bytes(content)


def _swap_files(files: Files, name: str, chance: random.Random) -> None:
    other = chance.choice(sorted(files))
    files[name], files[other] = files[other], files[name]


def _remove(files: Files, name: str, chance: random.Random) -> None:
    del files[name]


def _add(files: Files, name: str, chance: random.Random) -> None:
    files[f"{chance.choice(('', 'graphs/', 'assets/', 'new/'))}{chance.choice(string.ascii_letters)}.data"] = files[
        name
    ]


def _edit_json(files: Files, name: str, chance: random.Random) -> None:
    name = chance.choice([MANIFEST, MANIFEST, MANIFEST, "assets/vocabulary.json", "assets/statistics.json"])
    try:
        data = json.loads(files.get(name, b""))
        places = list(_places(data, ()))
        holder, key = chance.choice(places)
        _edit(holder, key, chance, places)
        files[name] = json.dumps(data).encode("utf-8", "surrogatepass")
    except (ValueError, IndexError, TypeError, RecursionError):
        _flip(files, next(iter(files), name), chance) if files else None


def _edit(holder: Any, key: Any, chance: random.Random, places: list[tuple[Any, Any]]) -> None:
    kind = chance.randrange(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[_misspelt(key, chance)] = holder.pop(key)
    elif kind == 2:
        other, its = chance.choice(places)
        holder[key], other[its] = copy.deepcopy(other[its]), copy.deepcopy(holder[key])
    elif kind == 3 and isinstance(holder[key], int | float):
        holder[key] = holder[key] * chance.choice((-1, 2, 1.01, 10**6, 10**12))
    elif kind == 4 and isinstance(holder, dict):
        holder[chance.choice(("folden", "x", "keep", "noise", ""))] = copy.deepcopy(chance.choice(STRANGE))
    else:
        holder[key] = copy.deepcopy(chance.choice(STRANGE))


def _misspelt(key: str, chance: random.Random) -> str:
    at = chance.randrange(len(key) + 1)
    return key[:at] + chance.choice(string.ascii_lowercase) + key[at + 1 :]


def _places(data: Any, path: tuple[Any, ...]) -> Any:
    pairs = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in list(pairs):
        yield data, key
        yield from _places(value, (*path, key))


def _edit_golden(files: Files, name: str, chance: random.Random) -> None:
    """Change an array of the golden file."""
    try:
        arrays = open_npz(files.get(GOLDEN, b""))
        key = chance.choice(sorted(arrays))
        value = arrays[key]
        other = chance.choice(sorted(arrays))
        changes = (value[:1], value[:0], np.zeros_like(value), arrays[other], value.reshape(-1), value.astype(str))
        arrays[chance.choice((key, other, "noise.x"))] = chance.choice(changes)
        place = Path(f"/dev/shm/{chance.getrandbits(64):x}.npz")
        try:
            save_npz(place, arrays)
            files[GOLDEN] = place.read_bytes()
        finally:
            place.unlink(missing_ok=True)
    except (VlatoolError, IndexError):
        _flip(files, name, chance)


def _span(content: bytes, chance: random.Random) -> tuple[int, int]:
    start = chance.randrange(len(content) + 1)
    return start, min(len(content), start + chance.choice((1, 2, 8, 64)))


CHANGES = (
    _flip, _flip, _flip, _flip, _cut, _drop, _insert, _swap_inside, _swap_files, _remove, _add, _edit_json, _edit_json,
    _edit_json, _edit_golden,
)  # fmt: skip
