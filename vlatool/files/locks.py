"""Who uses an entry of the cache: a process locks what it took from there until it ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

_HELD: dict[str, int] = {}
"""Path -> descriptor of a directory that this process uses."""


def hold(directory: Path) -> bool:
    """Lock an entry for this process, until it ends, and note that it was used now.

    Returns:
        False when there is no such directory, or it is being removed.
    """
    name = os.path.abspath(directory)
    try:
        handle = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        return not isinstance(error, FileNotFoundError | NotADirectoryError)  # too many files are open: unlocked then
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        if not is_at(handle, name):
            os.close(handle)
            return False
    except OSError:
        os.close(handle)
        return False
    release(directory)
    _HELD[name] = handle
    with contextlib.suppress(OSError):
        os.utime(handle)
    return True


def release(directory: Path) -> None:
    """Give up the lock of an entry, if this process has one."""
    handle = _HELD.pop(os.path.abspath(directory), None)
    if handle is not None:
        os.close(handle)


@contextlib.contextmanager
def alone(path: Path) -> Iterator[bool]:
    """Lock a file or directory that is to be removed; gives False while somebody uses it, or when it is gone."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        yield False
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        got = is_at(handle, os.fspath(path))
    except OSError:
        got = False
    try:
        yield got
    finally:
        os.close(handle)


def is_at(handle: int, path: str) -> bool:
    """Say whether an open directory is still the one of that name."""
    with contextlib.suppress(OSError):
        return os.path.samestat(os.fstat(handle), os.lstat(path))
    return False
