"""Files and directories that are on the disk, and not only in its cache, when a function returns.

A rename is durable once its directory is flushed (``fsync(2)``). Every change goes through ``os`` by path, so that the
order of the calls can be recorded and cut at each point (``tests/validation/updates/update_crashes.py``).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

MODE, FOLDER_MODE = 0o600, 0o700
DRAFT = ".{}.part"


def write_file(path: Path, pieces: Iterable[bytes]) -> None:
    """Write a file and flush it; its name is durable after ``sync_folder`` of its directory.

    Raises:
        OSError: when it cannot be written, or the path is a link.
    """
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, MODE)
    try:
        for piece in pieces:
            rest = memoryview(piece)
            while rest:
                rest = rest[os.write(handle, rest) :]
        os.fsync(handle)
    finally:
        os.close(handle)


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file: after a power cut at any time it has the old content or the new one.

    One writer at a time: the draft always has the same name, so that the next writer replaces what a cut left.

    Raises:
        OSError: when it cannot be written.
    """
    draft = path.with_name(DRAFT.format(path.name))
    write_file(draft, [content])
    os.replace(draft, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a directory: what was created, renamed and removed in it is durable.

    Raises:
        OSError: when it cannot be flushed.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Flush a directory and all directories below it."""
    for inner, _, _ in os.walk(folder, topdown=False):
        sync_folder(Path(inner))


def remove_tree(path: Path) -> None:
    """Remove a directory with all that is in it, or what else has that name; a process that has a file open keeps it.

    Raises:
        OSError: when something cannot be removed.
    """
    if not path.is_dir() or path.is_symlink():
        path.unlink(missing_ok=True)
        return
    for folder, folders, files in os.walk(path, topdown=False):
        for name in files:
            os.unlink(Path(folder) / name)
        for name in folders:
            inner = Path(folder) / name
            os.unlink(inner) if inner.is_symlink() else os.rmdir(inner)
    os.rmdir(path)
