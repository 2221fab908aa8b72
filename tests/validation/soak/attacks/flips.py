"""Flip every single bit of a manifest, and see that none is loaded with other actions.

``python tests/validation/soak/attacks/flips.py`` flips each bit of ``manifest.json`` and loads the bundle;
``--repaired`` writes the digest again after each flip, as an attacker would who may write that file, too: then the
types, names and golden steps have to catch what they can, and what loads with another answer is counted apart.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import victim

from vlatool.bundle.bundle import DIGEST, MANIFEST, digest_of
from vlatool.errors import VlatoolError

OTHER, FAR, RAW = "loaded, another answer", "loaded, another golden answer", "raw exception"


def flip_all(folder: Path, every: int = 1, *, repair: bool = False) -> Counter[str]:
    """Flip each ``every``-th bit of the manifest of a victim in ``folder`` and count what ``load`` makes of it."""
    path = victim.make(folder).path
    wanted = victim.answers(path)
    before = (path / MANIFEST).read_bytes()
    counts: Counter[str] = Counter()
    for bit in range(0, 8 * len(before), every):
        changed = bytearray(before)
        changed[bit // 8] ^= 1 << bit % 8
        (path / MANIFEST).write_bytes(changed)
        if repair:
            (path / DIGEST).write_bytes(digest_of(bytes(changed)))
        try:
            got = victim.answers(path)
            same = victim.equal(wanted, got)
            counts["loaded, same answer" if same else FAR if victim.far(wanted, got) else OTHER] += 1
        except VlatoolError as error:
            counts[f"refused: {type(error).__name__}"] += 1
        except Exception as error:
            counts[f"{RAW}: {type(error).__name__}: bit {bit}"] += 1
    return counts


def main() -> int:
    """Read the options, flip, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--repaired", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    folder = Path(tempfile.mkdtemp(prefix="flips-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    started = time.monotonic()
    try:
        counts = flip_all(folder / "bundle", options.every, repair=options.repaired)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    seconds = time.monotonic() - started
    print(f"{counts.total()} flips in {seconds:.0f} s: {counts.total() / seconds:.0f} each second")
    for name in sorted({*counts, OTHER, FAR}):
        print(f"{counts[name]:>10}  {name}")
    wrong = counts[FAR] + (0 if options.repaired else counts[OTHER])
    return int(wrong > 0 or any(name.startswith(RAW) for name in counts))


if __name__ == "__main__":
    sys.exit(main())
