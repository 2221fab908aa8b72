"""Locks on entries of the cache: a process holds a lock on each entry that it uses, until it ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

_LOCKS: dict[str, int] = {}
"""Path -> descriptor of a directory that this process has locked."""


def acquire(directory: Path) -> bool:
    """Take a shared lock on an entry until this process ends, and set the time of its last use.

    Returns:
        False when the directory does not exist, or is being removed.
    """
    name = os.path.abspath(directory)
    try:
        handle = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        return not isinstance(error, FileNotFoundError | NotADirectoryError)  # too many files are open: unlocked then
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        if not is_same_file(handle, name):
            os.close(handle)
            return False
    except OSError:
        os.close(handle)
        return False
    release(directory)
    _LOCKS[name] = handle
    with contextlib.suppress(OSError):
        os.utime(handle)
    return True


def release(directory: Path) -> None:
    """Release the lock on an entry, if this process has one."""
    handle = _LOCKS.pop(os.path.abspath(directory), None)
    if handle is not None:
        os.close(handle)


@contextlib.contextmanager
def exclusive_lock(path: Path) -> Iterator[bool]:
    """Lock a file or directory that is to be removed; yields False while another process uses it, or if it is gone."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        yield False
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        got = is_same_file(handle, os.fspath(path))
    except OSError:
        got = False
    try:
        yield got
    finally:
        os.close(handle)


def is_same_file(handle: int, path: str) -> bool:
    """Return whether an open file or directory is still the one at that path."""
    with contextlib.suppress(OSError):
        return os.path.samestat(os.fstat(handle), os.lstat(path))
    return False
