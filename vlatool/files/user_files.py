"""Atomic writes of single files; a file that a person wrote or edited is never replaced."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import hashlib
import os
import re
import stat
import uuid
from collections.abc import Iterator
from pathlib import Path

from vlatool.errors import OutputError
from vlatool.files.locks import exclusive_lock
from vlatool.files.ownership import add_to_ledger
from vlatool.files.scratch import rename_in_errors

DRAFT = ".{}.vlatool-{}-{}.part"
"""Name of a draft: name of the file, id of the process that writes it, and a random token."""
DRAFT_NAME = re.compile(r"\.(?P<final>.+)\.vlatool-(?P<process>\d+)-[0-9a-f]{8}\.part")


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a draft beside ``path`` that replaces ``path`` when the block ends and is removed when the block fails.

    A symbolic link is followed: its target is written. The draft is locked, so that the next writer of the same file
    recognizes and removes one that a killed process left.

    Raises:
        OSError: when the draft cannot be created or renamed, or is empty.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with atomic_file(target) as draft:
        ...     _ = draft.write_text("all of it")
        >>> target.read_text()
        'all of it'
    """
    target = path.resolve()
    remove_stale_drafts(target)
    draft = target.with_name(DRAFT.format(target.name, os.getpid(), uuid.uuid4().hex[:8]))
    with rename_in_errors(draft, str(path)):
        lock = os.open(draft, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with rename_in_errors(draft, str(path)):
            yield draft
            if not draft.stat().st_size:
                raise FileNotFoundError(errno.ENOENT, "nothing was written", str(draft))
            draft.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to report
            draft.unlink(missing_ok=True)
        raise
    finally:
        os.close(lock)


def remove_stale_drafts(path: Path) -> None:
    """Remove drafts of a file whose process has ended and whose lock is free."""
    for draft in path.parent.glob(f".{glob.escape(path.name)}.vlatool-*.part"):
        found = DRAFT_NAME.fullmatch(draft.name)
        if found is None or Path(f"/proc/{found['process']}").exists():
            continue
        with exclusive_lock(draft) as free, contextlib.suppress(OSError):
            if free and stat.S_ISREG(draft.lstat().st_mode):
                draft.unlink()


STAMP = "written by vlatool; SHA-256 of the lines above: "
MAX_BYTES = 1 << 26
"""Size of the largest file that ``is_own_file`` reads."""


def add_stamp(text: str, comment: str = "# {}") -> str:
    r"""Return a text with a last line that shows whether it was edited afterwards.

    Args:
        text: complete lines.
        comment: format string of a comment in this file format.

    Example:
        >>> add_stamp("a: 1\n").splitlines()[-1][:20]
        '# written by vlatool'
    """
    return f"{text}{comment.format(STAMP + _digest(text.encode()))}\n"


def stamp_of(content: bytes) -> bytes:
    """Return the stamp to append to ``content``, which ends in a line feed, for ``is_own_file`` to recognize the file.

    Only bytes without a line feed may follow it.

    Example:
        >>> len(stamp_of(b"GIF89a"))
        112
    """
    return (STAMP + _digest(content)).encode()


def remove_stamp(text: str) -> str:
    """Return a text without its stamp."""
    return "".join(line for line in text.splitlines(keepends=True) if STAMP not in line)


def is_own_file(path: Path) -> bool:
    """Return whether vlatool wrote a file and nobody has changed it since."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_BYTES:
        return False
    body, _, last = path.read_bytes().removesuffix(b"\n").rpartition(b"\n")
    return (STAMP + _digest(body + b"\n")).encode() in last


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def refuse_file(path: Path, *, force: bool) -> None:
    """Refuse to replace a file, unless ``force`` is set and vlatool wrote it, unchanged; raises OutputError."""
    if path.is_symlink():
        raise OutputError(f"{path} is a link; nothing is replaced through it.", "name another file")
    if path.is_dir():
        raise OutputError(f"{path} cannot be written: Is a directory.", "name a file")
    if os.path.lexists(path) and not force:
        raise OutputError(f"{path} exists already.", "choose another file, or pass --force to replace it")
    if os.path.lexists(path) and not is_own_file(path):
        raise OutputError(
            f"{path} was not written by vlatool, or was changed since, so --force does not replace it.",
            "choose another file, or move it away yourself",
        )


def write_own_file(path: Path, text: str, *, force: bool, comment: str = "# {}") -> None:
    """Write a text with a stamp; a later call may replace it as long as it is unchanged.

    Raises:
        OutputError: see ``refuse_file``.
        OSError: when it cannot be written.
    """
    refuse_file(path, force=force)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as draft:
        draft.write_text(add_stamp(text, comment), encoding="utf-8")
    add_to_ledger(path)
