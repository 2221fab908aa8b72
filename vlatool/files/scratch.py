"""Temporary directories, and errors that do not expose their paths to the user."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vlatool.errors import OutputError, VlatoolError
from vlatool.files.locks import exclusive_lock
from vlatool.files.outputs import DISK_FULL, OTHER_SCRATCH, SCRATCH, in_scratch
from vlatool.files.printable import file_of

MIN_FREE_BYTES = 1 << 20
"""Free bytes below which a disk counts as full."""


@contextlib.contextmanager
def rename_in_errors(path: Path, name: str, itself: str = "") -> Iterator[None]:
    """Replace a path in the errors that leave this block, of this process, of a child or of a library.

    Args:
        name: what replaces its path: another path, or empty to name its files relative to it.
        itself: what replaces the directory itself; ``name`` when empty.
    """
    try:
        yield
    except VlatoolError as error:
        error.message, error.fix = (_replace_path(text, path, name, itself) for text in (error.message, error.fix))
        raise
    except OSError as error:
        for which in ("filename", "filename2"):
            if isinstance(file := getattr(error, which), str | os.PathLike):
                setattr(error, which, _replace_path(os.fspath(file), path, name, itself))
        raise


def _replace_path(text: str, path: Path, name: str, itself: str) -> str:
    for written in dict.fromkeys((os.path.realpath(path), str(path))):
        text = text.replace(f"{written}/", f"{name}/" if name else "").replace(written, itself or name)
    return text


@contextlib.contextmanager
def scratch_directory() -> Iterator[Path]:
    """Yield an empty directory for temporary files and remove it afterwards; errors name its files without their path.

    If the process is killed, the next one that creates such a directory removes it.

    Raises:
        OutputError: when its disk becomes full.
        OSError: when it cannot be created.
    """
    _remove_stale(Path(tempfile.gettempdir()))
    path = Path(tempfile.mkdtemp(prefix=f"vlatool-{os.getpid()}-"))
    lock = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        with rename_in_errors(path, "", "a temporary directory"), _explain_full_disk(path):
            yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


@contextlib.contextmanager
def _explain_full_disk(path: Path) -> Iterator[None]:
    """Name the temporary folder where its disk is the full one: most such errors do not name a file."""
    try:
        yield
    except OSError as error:
        file = file_of(error)
        ours = in_scratch(Path(file)) if file else shutil.disk_usage(path).free < MIN_FREE_BYTES
        if error.errno not in DISK_FULL or not ours:
            raise
        message = f"Cannot write temporary files to {path.parent}: {DISK_FULL[error.errno]}."
        raise OutputError(message, OTHER_SCRATCH) from error


def _remove_stale(folder: Path) -> None:
    """Remove directories that killed processes left: the lock is free, and the process has ended."""
    for left in folder.glob("vlatool-*-*"):
        named = SCRATCH.fullmatch(left.name)
        if named is None or Path(f"/proc/{named['process']}").exists():
            continue
        with contextlib.suppress(OSError), exclusive_lock(left) as free:
            if free and left.lstat().st_uid == os.getuid():
                shutil.rmtree(left, ignore_errors=True)
