"""Places that a person never sees: folders for temporary files, and other names for what errors say of them."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vlatool.errors import OutputError, VlatoolError
from vlatool.files.locks import alone
from vlatool.files.outputs import FULL, OTHER_SCRATCH, SCRATCH, in_scratch
from vlatool.files.printable import file_of

ROOM = 1 << 20
"""Bytes that are free on a disk that is not full."""


@contextlib.contextmanager
def named_as(place: Path, name: str, itself: str = "") -> Iterator[None]:
    """Let no error that leaves this block name a place, of this process, a child or a library that is quoted.

    Args:
        place: A directory.
        name: What it is called for a person: a path, or nothing where its files are named from it on.
        itself: What the directory alone is called; ``name`` when empty.
    """
    try:
        yield
    except VlatoolError as error:
        error.message, error.fix = (_renamed(text, place, name, itself) for text in (error.message, error.fix))
        raise
    except OSError as error:
        for which in ("filename", "filename2"):
            if isinstance(file := getattr(error, which), str | os.PathLike):
                setattr(error, which, _renamed(os.fspath(file), place, name, itself))
        raise


def _renamed(text: str, place: Path, name: str, itself: str) -> str:
    for written in dict.fromkeys((os.path.realpath(place), str(place))):
        text = text.replace(f"{written}/", f"{name}/" if name else "").replace(written, itself or name)
    return text


@contextlib.contextmanager
def scratch_directory() -> Iterator[Path]:
    """Yield an empty directory for temporary files, and remove it with all that is in it; errors name its files alone.

    Where the process is killed, the next one that has such a directory removes it.

    Raises:
        OutputError: when the disk that it is on becomes full.
        OSError: when it cannot be made.
    """
    _sweep(Path(tempfile.gettempdir()))
    place = Path(tempfile.mkdtemp(prefix=f"vlatool-{os.getpid()}-"))
    lock = os.open(place, os.O_RDONLY | os.O_CLOEXEC)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        with named_as(place, "", "a temporary directory"), _full_disk(place):
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
        file = file_of(error)
        ours = in_scratch(Path(file)) if file else shutil.disk_usage(place).free < ROOM
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
