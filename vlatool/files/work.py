"""Work that takes long, kept in the cache so that a run that is killed goes on: one folder, one run at a time."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

LOCK = "lock"
FORGOTTEN_S = 7 * 24 * 3600
"""Age in seconds from which unfinished work that nobody continues is removed."""


@contextlib.contextmanager
def work_directory(place: Path) -> Iterator[Path]:
    """Yield the directory of unfinished work, locked: one run at a time continues it, others wait."""
    place.mkdir(parents=True, exist_ok=True)
    _sweep(place)
    handle = os.open(place / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        os.utime(place / LOCK)
        yield place
    finally:
        os.close(handle)


def forget(place: Path) -> None:
    """Remove a work directory whose result has arrived."""
    shutil.rmtree(place, ignore_errors=True)


def _sweep(place: Path) -> None:
    """Remove other work that nobody has continued for a week."""
    for other in place.parent.iterdir():
        with contextlib.suppress(OSError):
            if other == place or time.time_ns() / 1e9 - (other / LOCK).stat().st_mtime < FORGOTTEN_S:
                continue
            handle = os.open(other / LOCK, os.O_RDWR)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                forget(other)
            finally:
                os.close(handle)
