"""Renames that never replace anything, and two directories that change places at once."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
from pathlib import Path

AT_FDCWD = -100
NOREPLACE, EXCHANGE = 1, 2
UNKNOWN = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP)
"""What the kernel or a file system says that does not know such a rename."""


def move_new(source: Path, target: Path) -> None:
    """Rename a directory to a name that is free; of several who want the name at once exactly one gets it.

    Raises:
        FileExistsError: when the name is taken.
        OSError: for anything else.
    """
    if _rename(source, target, NOREPLACE):
        return
    os.mkdir(target)
    try:
        os.rename(source, target)
    except OSError:
        with contextlib.suppress(OSError):
            os.rmdir(target)
        raise


def exchange(one: Path, other: Path) -> bool:
    """Let two directories change places at once; False when the file system cannot.

    Raises:
        OSError: for anything else.
    """
    return _rename(one, other, EXCHANGE)


def _rename(source: Path, target: Path, flags: int) -> bool:
    """Call ``renameat2``; False when there is none here."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError):
        return False
    if call(AT_FDCWD, os.fsencode(source), AT_FDCWD, os.fsencode(target), ctypes.c_uint(flags)) == 0:
        return True
    number = ctypes.get_errno()
    if number in UNKNOWN:
        return False
    raise OSError(number, os.strerror(number), str(source), None, str(target))
