"""Bundles with links in free names, a listed file of 8 TB, and tokenizers that are bombs: each is refused, and at once.

``python tests/validation/soak/attacks/walls.py``
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import victim

from vlatool.bundle.bundle import Bundle, seal, write_manifest
from vlatool.bundle.manifest import FileRecord
from vlatool.errors import VlatoolError
from vlatool.runtime import load

SECONDS = 10.0
FREE = ("reports", "reports/report.html", "recipe.yaml", "SIGNATURE", ".written-by-vlatool.json", "graphs/.DS_Store")
LOADED, SLOW = "loaded", "took too long"
Attack = Callable[[Bundle], object]


def link(name: str) -> Attack:
    """Put a link where a file without a hash may be."""

    def attack(bundle: Bundle) -> None:
        (bundle.path / name).parent.mkdir(exist_ok=True)
        (bundle.path / name).symlink_to("/etc")

    return attack


def sparse(bundle: Bundle) -> None:
    """List a file that is large and empty."""
    with (bundle.path / "graphs/z.bin").open("wb") as stream:
        os.truncate(stream.fileno(), 1 << 43)
    record = FileRecord("0" * 64, 1 << 43)
    write_manifest(bundle.path, replace(bundle.manifest, files={**bundle.manifest.files, "graphs/z.bin": record}))


def bomb(**parts: Any) -> Attack:
    """Put a file of the tokenizers library in the place of the vocabulary."""
    model = {"type": "WordLevel", "vocab": {"go": 2, "[UNK]": 1}, "unk_token": "[UNK]"}
    empty = dict.fromkeys(("truncation", "padding", "normalizer", "pre_tokenizer", "post_processor", "decoder"))

    def attack(bundle: Bundle) -> None:
        content = {"version": "1.0", "added_tokens": [], **empty, "model": model, **parts}
        (bundle.path / "assets/vocabulary.json").write_text(json.dumps(content))
        seal(bundle.path, bundle.manifest)

    return attack


def attacks() -> Iterator[tuple[str, Attack]]:
    """Yield name and attack."""
    yield from ((f"link {name}", link(name)) for name in FREE)
    yield "sparse", sparse
    for pattern, content in (({"String": "o"}, "oo"), ({"Regex": "(?=o)"}, "o"), ({"String": ""}, "o")):
        steps = [{"type": "Replace", "pattern": pattern, "content": content}] * 40
        yield f"replace {pattern}", bomb(normalizer={"type": "Sequence", "normalizers": steps})
    steps = [{"type": "ByteLevel", "add_prefix_space": True, "trim_offsets": True, "use_regex": False}] * 20
    yield "bytes of bytes", bomb(pre_tokenizer={"type": "Sequence", "pretokenizers": steps})


def run(folder: Path) -> Counter[str]:
    """Attack a fresh bundle in every way; count what came of it."""
    counts: Counter[str] = Counter()
    for number, (_, attack) in enumerate(attacks()):
        bundle = victim.make(folder / str(number))
        attack(bundle)
        began = time.monotonic()
        try:
            load(bundle.path, threads=1, warmup=0)
            counts[LOADED] += 1
        except VlatoolError as error:
            counts[f"refused: {type(error).__name__}"] += 1
        counts[SLOW] += time.monotonic() - began > SECONDS
    return counts


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        found = run(Path(scratch))
    print(f"{sum(found.values()) - found[SLOW]} tries: {dict(+found)}")
    raise SystemExit(1 if found[LOADED] or found[SLOW] else 0)
