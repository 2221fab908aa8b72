"""Atomic writes of directories: a reader never sees half of one, and nothing that others wrote is replaced.

While ``out`` is being written, ``.out.tmp-PID-TOKEN`` beside it holds a marker and ``content``, which is filled and
then changes places with ``out``. The previous directory is then removed file by file, as far as vlatool wrote it. The
marker holds the inodes of both directories: a directory that merely has such a name is not taken for a draft.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import json
import os
import re
import shutil
import threading
import uuid
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vlatool.errors import OutputError
from vlatool.files.atomic_rename import exchange, rename_to_new
from vlatool.files.locks import exclusive_lock
from vlatool.files.outputs import kind_of, output_errors, refuse_replacing
from vlatool.files.ownership import remove_owned, write_ledger
from vlatool.files.scratch import rename_in_errors

MARKER = "vlatool-draft.json"
CONTENT, PREVIOUS_NAME = "content", "old"
DRAFT_SUFFIX = re.compile(r"\.tmp-\d+-[0-9a-f]{8}$")
MAX_ATTEMPTS = 10


@dataclass(frozen=True)
class _Draft:
    """A directory that is being written: its path, and the inode of its content."""

    path: Path
    inode: int

    @property
    def content(self) -> Path:
        """The new directory; after the exchange, the previous one."""
        return self.path / CONTENT

    @property
    def old(self) -> Path:
        """The previous directory, where directories cannot be exchanged."""
        return self.path / PREVIOUS_NAME

    @classmethod
    def make(cls, final: Path) -> _Draft:
        """Create an empty draft beside its final path."""
        path = final.with_name(f".{final.name}.tmp-{os.getpid()}-{uuid.uuid4().hex[:8]}")
        path.mkdir()
        try:
            draft = path / CONTENT
            draft.mkdir()
            inode = draft.stat().st_ino
            marker = {"vlatool": "a draft", "place": path.stat().st_ino, "content": inode}
            (path / MARKER).write_text(json.dumps(marker) + "\n", encoding="utf-8")
        except BaseException:
            with contextlib.suppress(OSError):
                (path / MARKER).unlink(missing_ok=True)
            _remove_empty(path)
            raise
        return cls(path, inode)

    @classmethod
    def existing(cls, path: Path) -> _Draft | None:
        """Return the draft of another writer, None for a directory that is not a draft."""
        try:
            if (path / MARKER).is_symlink():
                return None
            marker = json.loads((path / MARKER).read_text(encoding="utf-8"))
            mine = marker["vlatool"] == "a draft" and marker["place"] == path.stat().st_ino
            return cls(path, int(marker["content"])) if mine else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def dispose(self, final: Path, *, changed: bool = False) -> None:
        """Remove the draft; what it replaced is restored when nothing replaced it, and removed otherwise."""
        if os.path.lexists(self.old) and not os.path.lexists(final):
            with contextlib.suppress(OSError):
                rename_to_new(self.old, final)
        left = [self.old] if os.path.lexists(self.old) and not remove_owned(self.old, changed=changed) else []
        with contextlib.suppress(OSError):
            if self.content.lstat().st_ino == self.inode:
                shutil.rmtree(self.content, ignore_errors=True)
            elif not remove_owned(self.content, changed=changed):
                left.append(self.content)
        for kept in left:
            _keep_aside(kept, final)
        with contextlib.suppress(OSError):
            (self.path / MARKER).unlink()
        with contextlib.suppress(OSError):
            self.path.rmdir()


CREATION_LOCK = threading.Lock()
"""Held until a draft is locked: another thread would take it for a stale one of an earlier process with this id."""


@contextlib.contextmanager
def write_directory(final: Path, *, force: bool = False, damaged: bool = False) -> Iterator[Path]:
    """Yield an empty directory that becomes ``final`` when the block succeeds.

    Everything is flushed to disk before the rename, so that a reader sees either the previous or the complete new
    directory. What a killed writer left behind is removed by the next one. Of several writers that must not replace
    anything exactly one succeeds.

    Args:
        force: whether to replace an unchanged directory that vlatool wrote.
        damaged: whether to replace any directory, moving aside what vlatool did not write (for the cache).

    Raises:
        OutputError: when ``final`` exists (without ``force``), is not vlatool's, or the disk is read-only or full.
    """
    typed, final = final, Path(os.path.abspath(final))
    with output_errors(final, cache=damaged):
        if not damaged:
            refuse_replacing(final, force=force)
        final.parent.mkdir(parents=True, exist_ok=True)
        with CREATION_LOCK:
            remove_stale_directories(final)
            draft = _Draft.make(final)
            lock = os.open(draft.path, os.O_RDONLY)
            fcntl.flock(lock, fcntl.LOCK_EX)
    stage = f"the output of {final.name.rpartition('-')[0] or final.name}"
    name, itself = ("", stage) if damaged else (str(typed), "")
    try:
        with (
            rename_in_errors(draft.path, name, itself),
            rename_in_errors(draft.content, name, itself),
            output_errors(final, cache=damaged),
        ):
            yield draft.content
            write_ledger(draft.content)
            _flush(draft.content)
            os.utime(draft.content)  # flushing may take minutes, and old entries may be pruned
            _move(draft, final, force, damaged)
    finally:
        os.close(lock)
        draft.dispose(final, changed=damaged)


def remove_stale_directories(final: Path) -> None:
    """Remove drafts of ``final`` whose writer has ended."""
    for path in final.parent.glob(f".{glob.escape(final.name)}.tmp-*-*"):
        if not DRAFT_SUFFIX.search(path.name) or path.is_symlink() or _is_alive(path):
            continue
        draft = _Draft.existing(path)
        if draft is not None:
            draft.dispose(final)
        else:
            _remove_empty(path)


def _remove_empty(path: Path) -> None:
    """Remove a draft that has at most an empty directory and an empty marker."""
    with contextlib.suppress(OSError):
        if (path / CONTENT).is_dir():
            (path / CONTENT).rmdir()
        if (path / MARKER).is_file() and (path / MARKER).lstat().st_size == 0:
            (path / MARKER).unlink()
        path.rmdir()


def _is_alive(path: Path) -> bool:
    """Return whether a draft is in use: its process exists on this machine, or its lock is taken."""
    pid = path.name.rpartition(".tmp-")[2].partition("-")[0]
    if pid.isdigit() and int(pid) != os.getpid() and Path(f"/proc/{pid}").exists():
        return True
    with exclusive_lock(path) as free:
        return not free and os.path.lexists(path)


def _flush(directory: Path) -> None:
    for path in [*directory.rglob("*"), directory]:
        if not path.is_symlink():
            _sync(path)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _move(draft: _Draft, final: Path, force: bool, damaged: bool) -> None:
    """Rename a draft to its final path, exchanging it with a previous directory that may be replaced."""
    for _ in range(MAX_ATTEMPTS):
        try:
            rename_to_new(draft.content, final)
            break
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
        if not damaged:
            refuse_replacing(final, force=force, kind=kind_of(draft.content))
        with contextlib.suppress(FileNotFoundError):  # another writer is removing it
            _replace(draft, final)
            break
    else:
        raise OutputError(f"{final} is being written by other processes.", "run it again")
    _sync(final.parent)


def _replace(draft: _Draft, final: Path) -> None:
    """Exchange the draft with what is there; where that is not supported, move it aside, and back on failure."""
    if exchange(draft.content, final):
        return
    os.rename(final, draft.old)
    try:
        rename_to_new(draft.content, final)
    except BaseException:
        rename_to_new(draft.old, final)
        raise


def _keep_aside(left: Path, final: Path) -> None:
    """Move what vlatool did not write to a visible name beside the output."""
    aside = final.with_name(f"{final.name}.kept-{uuid.uuid4().hex[:8]}")
    with contextlib.suppress(OSError):
        rename_to_new(left, aside)
        warnings.warn(f"{aside} holds what was in {final} and was not written by vlatool", stacklevel=2)
