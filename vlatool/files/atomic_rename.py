"""Renames that never replace anything, and the atomic exchange of two directories."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
from pathlib import Path

AT_FDCWD = -100
NOREPLACE, EXCHANGE = 1, 2
UNSUPPORTED_ERRORS = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP)
"""Errors of a kernel or file system without such renames."""


def rename_to_new(source: Path, target: Path) -> None:
    """Rename a directory to a path that does not exist; of several concurrent callers exactly one succeeds.

    Raises:
        FileExistsError: when the path exists.
        OSError: for any other failure.
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
    """Exchange two directories atomically; False where the file system cannot; raises OSError for other failures."""
    return _rename(one, other, EXCHANGE)


def _rename(source: Path, target: Path, flags: int) -> bool:
    """Call ``renameat2``; return False when it is not supported."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError):
        return False
    if call(AT_FDCWD, os.fsencode(source), AT_FDCWD, os.fsencode(target), ctypes.c_uint(flags)) == 0:
        return True
    number = ctypes.get_errno()
    if number in UNSUPPORTED_ERRORS:
        return False
    raise OSError(number, os.strerror(number), str(source), None, str(target))
