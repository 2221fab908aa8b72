"""A directory is written so that a reader never sees half of it, and never over what somebody else wrote.

Beside ``out`` lies, while it is written, ``.out.tmp-PID-TOKEN``: a marker, and ``content``, which is filled and then
takes the place of ``out``. What was there before takes its place in turn, and is removed file by file as far as vlatool
wrote it. The marker holds the inodes of both directories: a directory that is only called so is nobody's draft.
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
from vlatool.files.locks import alone
from vlatool.files.moves import exchange, move_new
from vlatool.files.outputs import kind_of, output_errors, refuse_replacing
from vlatool.files.scratch import named_as
from vlatool.files.written import note, prune

MARKER = "vlatool-draft.json"
CONTENT, OLD = "content", "old"
NAME = re.compile(r"\.tmp-\d+-[0-9a-f]{8}$")
ATTEMPTS = 10


@dataclass(frozen=True)
class _Draft:
    """A directory that is being written: where it lies, and the inode of what is written."""

    place: Path
    inode: int

    @property
    def content(self) -> Path:
        """Where it is written; once it has taken its place, what was there before."""
        return self.place / CONTENT

    @property
    def old(self) -> Path:
        """What was there before, where directories cannot change places."""
        return self.place / OLD

    @classmethod
    def make(cls, final: Path) -> _Draft:
        """Make an empty draft beside its final name."""
        place = final.with_name(f".{final.name}.tmp-{os.getpid()}-{uuid.uuid4().hex[:8]}")
        place.mkdir()
        try:
            draft = place / CONTENT
            draft.mkdir()
            inode = draft.stat().st_ino
            marker = {"vlatool": "a draft", "place": place.stat().st_ino, "content": inode}
            (place / MARKER).write_text(json.dumps(marker) + "\n", encoding="utf-8")
        except BaseException:
            with contextlib.suppress(OSError):
                (place / MARKER).unlink(missing_ok=True)
            _remove_begun(place)
            raise
        return cls(place, inode)

    @classmethod
    def found(cls, place: Path) -> _Draft | None:
        """Return the draft of another writer, None for a directory that is none."""
        try:
            if (place / MARKER).is_symlink():
                return None
            marker = json.loads((place / MARKER).read_text(encoding="utf-8"))
            mine = marker["vlatool"] == "a draft" and marker["place"] == place.stat().st_ino
            return cls(place, int(marker["content"])) if mine else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def dispose(self, final: Path, *, changed: bool = False) -> None:
        """Remove the draft; what it replaced comes back when nothing took its place, and goes else."""
        if os.path.lexists(self.old) and not os.path.lexists(final):
            with contextlib.suppress(OSError):
                move_new(self.old, final)
        left = [self.old] if os.path.lexists(self.old) and not prune(self.old, changed=changed) else []
        with contextlib.suppress(OSError):
            if self.content.lstat().st_ino == self.inode:
                shutil.rmtree(self.content, ignore_errors=True)
            elif not prune(self.content, changed=changed):
                left.append(self.content)
        for kept in left:
            _keep(kept, final)
        with contextlib.suppress(OSError):
            (self.place / MARKER).unlink()
        with contextlib.suppress(OSError):
            self.place.rmdir()


BEGINNING = threading.Lock()
"""Held until a draft is locked: another thread would take it for one that was left behind by this process's number."""


@contextlib.contextmanager
def writing(final: Path, *, force: bool = False, damaged: bool = False) -> Iterator[Path]:
    """Yield a fresh directory that becomes ``final`` when the block ends well.

    Everything is flushed to disk before the rename, so that a reader sees what was there before or the whole new
    directory. What a killed writer left behind is removed by the next one. Of several writers that may not replace
    anything exactly one ends well.

    Args:
        final: The directory.
        force: Replace a directory that vlatool wrote and that nobody changed since.
        damaged: Replace what is there in any case, and keep what vlatool did not write beside it: for the cache.

    Raises:
        OutputError: when ``final`` exists (and not ``force``), is not vlatool's, or the place is read-only or full.
    """
    typed, final = final, Path(os.path.abspath(final))
    with output_errors(final, cache=damaged):
        if not damaged:
            refuse_replacing(final, force=force)
        final.parent.mkdir(parents=True, exist_ok=True)
        with BEGINNING:
            sweep(final)
            draft = _Draft.make(final)
            lock = os.open(draft.place, os.O_RDONLY)
            fcntl.flock(lock, fcntl.LOCK_EX)
    stage = f"the output of {final.name.rpartition('-')[0] or final.name}"
    name, itself = ("", stage) if damaged else (str(typed), "")
    try:
        with (
            named_as(draft.place, name, itself),
            named_as(draft.content, name, itself),
            output_errors(final, cache=damaged),
        ):
            yield draft.content
            note(draft.content)
            _flush(draft.content)
            os.utime(draft.content)  # flushing may take minutes, and what is old may be pruned
            _move(draft, final, force, damaged)
    finally:
        os.close(lock)
        draft.dispose(final, changed=damaged)


def sweep(final: Path) -> None:
    """Remove drafts of ``final`` whose writer is gone."""
    for place in final.parent.glob(f".{glob.escape(final.name)}.tmp-*-*"):
        if not NAME.search(place.name) or place.is_symlink() or _is_alive(place):
            continue
        draft = _Draft.found(place)
        if draft is not None:
            draft.dispose(final)
        else:
            _remove_begun(place)


def _remove_begun(place: Path) -> None:
    """Remove a draft in which nothing was written yet: at most an empty directory and an empty marker."""
    with contextlib.suppress(OSError):
        if (place / CONTENT).is_dir():
            (place / CONTENT).rmdir()
        if (place / MARKER).is_file() and (place / MARKER).lstat().st_size == 0:
            (place / MARKER).unlink()
        place.rmdir()


def _is_alive(place: Path) -> bool:
    """A draft is alive while its process exists here or anybody holds its lock."""
    pid = place.name.rpartition(".tmp-")[2].partition("-")[0]
    if pid.isdigit() and int(pid) != os.getpid() and Path(f"/proc/{pid}").exists():
        return True
    with alone(place) as free:
        return not free and os.path.lexists(place)


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
    """Give a draft its final name, and take in what was there before, when that may be replaced."""
    for _ in range(ATTEMPTS):
        try:
            move_new(draft.content, final)
            break
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
        if not damaged:
            refuse_replacing(final, force=force, kind=kind_of(draft.content))
        with contextlib.suppress(FileNotFoundError):  # another writer takes it away just now
            _replace(draft, final)
            break
    else:
        raise OutputError(f"{final} is being written by others.", "run it again")
    _sync(final.parent)


def _replace(draft: _Draft, final: Path) -> None:
    """Change places with what is there; where directories cannot, move it aside and back again when that fails."""
    if exchange(draft.content, final):
        return
    os.rename(final, draft.old)
    try:
        move_new(draft.content, final)
    except BaseException:
        move_new(draft.old, final)
        raise


def _keep(left: Path, final: Path) -> None:
    """Give what vlatool did not write, and what came while it wrote, a name that a person sees."""
    kept = final.with_name(f"{final.name}.kept-{uuid.uuid4().hex[:8]}")
    with contextlib.suppress(OSError):
        move_new(left, kept)
        warnings.warn(f"{kept} holds what was in {final} and was not written by vlatool", stacklevel=2)
