"""Small files of directories that others made: read whole, up to a limit, and only where they are regular files."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from vlatool.errors import VlatoolError
from vlatool.files.limits import check_limit, limit
from vlatool.files.verified_read import read_all


def read_bounded(path: Path, allowed: str, error: type[VlatoolError]) -> bytes:
    """Return the content of a file; a link to one is followed, as caches of checkpoints have them.

    A pipe would be waited for without end, and a device such as ``/dev/zero`` has a size of 0 and no end.

    Args:
        allowed: name of the limit on its bytes.
        error: raised above it.

    Raises:
        OSError: when it is missing, or not a regular file.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(path))
        check_limit(allowed, about.st_size, str(path), error)
        content = read_all(handle, min(about.st_size, limit(allowed)))
    finally:
        os.close(handle)
    check_limit(allowed, len(content), str(path), error)
    return content
