"""What an engine builds from a graph for one card and release, kept between processes.

A build that ended early, or whose answers were never compared with the golden action, is not used again: it is made in
a directory of its process, which gets its name once the comparison was good.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from vlatool.machine.host import cache_directory

FOLDER = "engines"
BUILDING = ".building-"


class EngineCache:
    """The directory of one graph in one engine.

    Args:
        parts: All that makes what was built invalid: hash of the graph and its weights, options, device, driver,
            releases.
    """

    def __init__(self, parts: Iterable[str]) -> None:
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
        self._final = cache_directory() / FOLDER / key
        self.proven = self._final.is_dir()
        """Whether an earlier process built it, and compared its answers."""
        self._remove_unfinished()
        self.path = self._final if self.proven else self._final.with_name(f"{key}{BUILDING}{os.getpid()}")
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)

    def keep(self) -> None:
        """Let later processes use what was built; where another process was first, its build stays."""
        if self.proven:
            return
        try:
            self.path.rename(self._final)
        except OSError:
            shutil.rmtree(self.path, ignore_errors=True)
        self.path, self.proven = self._final, True

    def discard(self) -> None:
        """Remove what was built: it does not compute what it should."""
        shutil.rmtree(self.path, ignore_errors=True)

    def _remove_unfinished(self) -> None:
        """Remove the builds of processes that are gone."""
        for left in self._final.parent.glob(f"{self._final.name}{BUILDING}*"):
            process = left.name.rpartition("-")[2]
            if process.isdigit() and not Path("/proc", process).exists():
                shutil.rmtree(left, ignore_errors=True)
