"""A directory is written so that a reader never sees half of it."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from vlatool.errors import OutputError

OURS = ("manifest.json", "report.json", "policy.yaml")
"""Files that tell a directory which vlatool wrote from any other; only those are replaced by --force."""


@contextlib.contextmanager
def writing(final: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a fresh directory beside ``final`` that becomes ``final`` when the block ends well.

    Everything is flushed to disk before the rename, so that a reader sees what was there before, nothing, or the whole
    new directory. What a killed writer left behind is removed by the next one.

    Raises:
        OutputError: when ``final`` exists (and not ``force``), or the place is read-only or full.
    """
    final = Path(os.path.abspath(final))
    with _output_errors(final):
        if os.path.exists(final) and not force:
            raise OutputError(f"{final} exists already.", "choose another output, or pass --force to replace it")
        final.parent.mkdir(parents=True, exist_ok=True)
        sweep(final)
        draft = final.with_name(f".{final.name}.tmp-{os.getpid()}-{uuid.uuid4().hex[:8]}")
        draft.mkdir()
    lock = os.open(draft, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with _output_errors(final):
            yield draft
            _flush(draft)
            _move(draft, final)
    finally:
        os.close(lock)
        shutil.rmtree(draft, ignore_errors=True)


def sweep(final: Path) -> None:
    """Remove drafts of ``final`` whose writer is gone."""
    name = glob.escape(final.name)
    for stale in final.parent.glob(f".{name}.tmp-*"):
        if not _is_alive(stale):
            shutil.rmtree(stale, ignore_errors=True)
    for stale in final.parent.glob(f".{name}.old-*"):
        if final.exists():
            shutil.rmtree(stale, ignore_errors=True)


def _is_alive(draft: Path) -> bool:
    """A draft is alive while its process exists here or anybody holds its lock."""
    pid = draft.name.rpartition(".tmp-")[2].partition("-")[0]
    if pid.isdigit() and int(pid) != os.getpid() and Path(f"/proc/{pid}").exists():
        return True
    try:
        handle = os.open(draft, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(handle)
    return False


def _flush(directory: Path) -> None:
    for path in [*directory.rglob("*"), directory]:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _move(draft: Path, final: Path) -> None:
    old = final.with_name(f".{final.name}.old-{uuid.uuid4().hex[:8]}")
    if final.exists():
        os.rename(final, old)
    os.rename(draft, final)
    handle = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
    if old.is_dir():
        shutil.rmtree(old, ignore_errors=True)
    else:
        old.unlink(missing_ok=True)


@contextlib.contextmanager
def _output_errors(final: Path) -> Iterator[None]:
    """Map the operating system's refusals to write into one sentence for the person."""
    try:
        yield
    except OSError as error:
        reason = {
            errno.ENOSPC: ("the disk is full", "free some space, or write elsewhere"),
            errno.EDQUOT: ("the disk quota is used up", "free some space, or write elsewhere"),
            errno.EROFS: ("the file system is read-only", "write elsewhere"),
            errno.EACCES: ("permission denied", "write elsewhere, or change the permissions of the directory"),
            errno.EFBIG: ("a file would be larger than the limit on file sizes", "raise the limit (ulimit -f)"),
            errno.ENAMETOOLONG: ("the name is too long", "choose a shorter one"),
            errno.EEXIST: ("a part of the path is a file", "choose another output"),
            errno.ENOTDIR: ("a part of the path is a file", "choose another output"),
        }.get(error.errno or 0)
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        named = Path(str(error.filename or "-"))
        drafts = any(part.startswith(f".{final.name}.") for part in named.parts)
        ours = drafts or named.is_relative_to(final) or final.is_relative_to(named)
        if reason is None or not (full or ours):
            raise
        raise OutputError(f"Cannot write {final}: {reason[0]}.", reason[1]) from error
