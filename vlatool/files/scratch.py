"""Places that a person never sees: what lies in them is gone, or has another name, when an error is read."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vlatool.errors import OutputError, VlatoolError

FULL = (errno.ENOSPC, errno.EDQUOT)


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
        if isinstance(error.filename, str | os.PathLike):
            error.filename = _renamed(os.fspath(error.filename), place, name, itself)
        raise


def _renamed(text: str, place: Path, name: str, itself: str) -> str:
    for written in dict.fromkeys((os.path.realpath(place), str(place))):
        text = text.replace(f"{written}/", f"{name}/" if name else "").replace(written, itself or name)
    return text


@contextlib.contextmanager
def scratch_directory(prefix: str = "vlatool-") -> Iterator[Path]:
    """Yield an empty directory for files that nobody needs afterwards; errors name its files alone.

    Raises:
        OutputError: when it cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix=prefix) as folder:
        place = Path(folder)
        try:
            with named_as(place, "", "a temporary directory"):
                yield place
        except OSError as error:
            if error.errno not in FULL or os.statvfs(place).f_bavail:
                raise
            raise OutputError(
                f"Cannot write temporary files to {place.parent}: the disk is full.",
                "free some space, or name another directory: TMPDIR=DIR",
            ) from error
