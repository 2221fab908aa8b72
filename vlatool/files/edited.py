"""Files that are written whole or not at all, and never over what a person wrote."""

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
from vlatool.files.locks import alone
from vlatool.files.scratch import named_as
from vlatool.files.written import note_file

DRAFT = ".{}.vlatool-{}-{}.part"
"""What a draft is called: the file's name, the number of the process that writes it, and which of its drafts it is."""
DRAFT_NAME = re.compile(r"\.(?P<final>.+)\.vlatool-(?P<process>\d+)-[0-9a-f]{8}\.part")


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a draft beside ``path``: it takes the place of ``path`` when the block ends, and is removed when it fails.

    A symbolic link stays one: the file that it leads to is written. The draft is locked, so that one that a killed
    process left is known as such: the next writer of the same file removes it.

    Raises:
        OSError: when the draft cannot be made or moved, or nothing was written to it.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with whole_file(target) as draft:
        ...     _ = draft.write_text("all of it")
        >>> target.read_text()
        'all of it'
    """
    target = path.resolve()
    sweep_drafts(target)
    draft = target.with_name(DRAFT.format(target.name, os.getpid(), uuid.uuid4().hex[:8]))
    lock = os.open(draft, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with named_as(draft, str(path)):
            yield draft
            if not draft.stat().st_size:
                raise FileNotFoundError(errno.ENOENT, "nothing was written", str(draft))
            draft.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to tell
            draft.unlink(missing_ok=True)
        raise
    finally:
        os.close(lock)


def sweep_drafts(path: Path) -> None:
    """Remove drafts of a file whose process is gone, and whose lock is free."""
    for draft in path.parent.glob(f".{glob.escape(path.name)}.vlatool-*.part"):
        found = DRAFT_NAME.fullmatch(draft.name)
        if found is None or Path(f"/proc/{found['process']}").exists():
            continue
        with alone(draft) as free, contextlib.suppress(OSError):
            if free and stat.S_ISREG(draft.lstat().st_mode):
                draft.unlink()


STAMP = "written by vlatool; SHA-256 of the lines above: "
LARGEST = 1 << 26
"""Bytes of the largest file that may be one of vlatool's."""


def stamped(text: str, comment: str = "# {}") -> str:
    r"""Return a text with a last line that tells whether somebody changed it since.

    Args:
        text: Whole lines.
        comment: What a comment looks like in this format.

    Example:
        >>> stamped("a: 1\n").splitlines()[-1][:20]
        '# written by vlatool'
    """
    return f"{text}{comment.format(STAMP + _digest(text.encode()))}\n"


def stamp_of(content: bytes) -> bytes:
    """Return what a binary file says after ``content``, which ends in a line feed, so that ``is_own`` knows it again.

    Nothing but bytes without a line feed may follow.

    Example:
        >>> len(stamp_of(b"GIF89a"))
        112
    """
    return (STAMP + _digest(content)).encode()


def unstamped(text: str) -> str:
    """Return a text without the lines that ``stamped`` adds."""
    return "".join(line for line in text.splitlines(keepends=True) if STAMP not in line)


def is_own(path: Path) -> bool:
    """Say whether vlatool wrote a file and nobody changed it since."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size > LARGEST:
        return False
    body, _, last = path.read_bytes().removesuffix(b"\n").rpartition(b"\n")
    return (STAMP + _digest(body + b"\n")).encode() in last


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def refuse_file(path: Path, *, force: bool) -> None:
    """Refuse a file that exists, unless vlatool wrote it, nobody changed it, and it may be replaced.

    Raises:
        OutputError: saying why it is not replaced.
    """
    if path.is_symlink():
        raise OutputError(f"{path} is a link; nothing is replaced through it.", "name another file")
    if path.is_dir():
        raise OutputError(f"{path} cannot be written: Is a directory.", "name a file")
    if os.path.lexists(path) and not force:
        raise OutputError(f"{path} exists already.", "choose another file, or pass --force to replace it")
    if os.path.lexists(path) and not is_own(path):
        raise OutputError(
            f"{path} was not written by vlatool, or was changed since, so --force does not replace it.",
            "choose another file, or move it away yourself",
        )


def write_own(path: Path, text: str, *, force: bool, comment: str = "# {}") -> None:
    """Write a text that a later ``write_own`` may replace while nobody changed it.

    Raises:
        OutputError: see ``refuse_file``.
        OSError: when it cannot be written.
    """
    refuse_file(path, force=force)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as draft:
        draft.write_text(stamped(text, comment), encoding="utf-8")
    note_file(path)
