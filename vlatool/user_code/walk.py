"""The files below a folder of user code."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from vlatool.user_code.trust import CACHE


def files_below(folder: Path) -> Iterator[Path]:
    """Yield the regular files below a folder, sorted; links are followed, each directory is entered once.

    Hidden ones and bytecode are left out: they are not part of a policy or an environment. A directory
    that cannot be read has none.
    """
    seen: set[tuple[int, int]] = set()
    for root, folders, names in os.walk(folder, followlinks=True):
        about = os.stat(root)
        if (about.st_dev, about.st_ino) in seen:
            folders[:] = []
            continue
        seen.add((about.st_dev, about.st_ino))
        folders[:] = sorted(name for name in folders if name != CACHE and not name.startswith("."))
        for name in sorted(names):
            path = Path(root, name)
            if not name.startswith(".") and path.is_file():
                yield path
