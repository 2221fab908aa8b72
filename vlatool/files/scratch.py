"""A folder for temporary files: removed when it is no longer needed, after a kill by the next process that has one."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vlatool.errors import OutputError
from vlatool.files.locks import alone
from vlatool.files.outputs import FULL, OTHER_SCRATCH, SCRATCH, in_scratch
from vlatool.files.printable import file_of

ROOM = 1 << 20
"""Bytes that are free on a disk that is not full."""


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Yield an empty folder for temporary files, and remove it with all that is in it when the block ends.

    Raises:
        OutputError: when the disk that it is on becomes full.
        OSError: when it cannot be made.
    """
    _sweep(Path(tempfile.gettempdir()))
    place = Path(tempfile.mkdtemp(prefix=f"vlatool-{os.getpid()}-"))
    lock = os.open(place, os.O_RDONLY | os.O_CLOEXEC)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        with _full_disk(place):
            yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
        os.close(lock)


@contextlib.contextmanager
def _full_disk(place: Path) -> Iterator[None]:
    """Blame the temporary folder where its disk is the full one: most such errors do not say which file it was."""
    try:
        yield
    except OSError as error:
        ours = in_scratch(Path(file)) if (file := file_of(error)) else shutil.disk_usage(place).free < ROOM
        if error.errno not in FULL or not ours:
            raise
        message = f"Cannot write temporary files to {place.parent}: {FULL[error.errno]}."
        raise OutputError(message, OTHER_SCRATCH) from error


def _sweep(folder: Path) -> None:
    """Remove what processes that were killed have left: the lock of a folder is free, and its process is gone."""
    for left in folder.glob("vlatool-*-*"):
        named = SCRATCH.fullmatch(left.name)
        if named is None or Path(f"/proc/{named['process']}").exists():
            continue
        with contextlib.suppress(OSError), alone(left) as free:
            if free and left.lstat().st_uid == os.getuid():
                shutil.rmtree(left, ignore_errors=True)
