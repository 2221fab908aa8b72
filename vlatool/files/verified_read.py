"""Files below a directory, read without following links, as exactly the bytes that were hashed."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from vlatool.errors import BundleError
from vlatool.files.limits import limit

DESKTOP_FILES = (".DS_Store", "Thumbs.db", "desktop.ini")
"""Files that desktop environments leave in directories."""
LEDGER = ".written-by-vlatool.json"
"""The record of what vlatool wrote into a directory (``vlatool.files.ownership``)."""
COPY_AGAIN = "copy or export the bundle again"
BLOCK = 1 << 20
TICK_NS = 20_000_000
"""Time stamps of files move in ticks of up to 10 ms: a second change within one tick cannot be detected."""


def read_verified(root: Path, name: str, sha256: str, size: int) -> bytes:
    """Return the content of a file below ``root`` after checking it against what was recorded.

    Args:
        root: directory; the path to it may contain links, the path below it must not.
        name: relative path with ``/``.

    Raises:
        BundleError: when it is missing, a link, or has another size or content.
    """
    with open_inside(root, name) as handle:
        check_size(root, name, handle, size)
        content = read_all(handle, size)
    check_content(root, name, hashlib.sha256(content).hexdigest() if len(content) == size else "", sha256)
    return content


def verify_file(root: Path, name: str, sha256: str, size: int) -> None:
    """Check a file as ``read_verified`` does, block by block."""
    with open_inside(root, name) as handle:
        check_size(root, name, handle, size)
        check_content(root, name, hash_handle(handle), sha256)


def check_size(root: Path, name: str, handle: int, size: int) -> None:
    """Refuse an open file whose size differs from the recorded one."""
    got = os.fstat(handle).st_size
    if got != size:
        raise BundleError(f"{root / name} has {got} bytes; the manifest says {size}.", COPY_AGAIN)


def check_content(root: Path, name: str, got: str, recorded: str) -> None:
    """Refuse a SHA-256 that differs from the recorded one."""
    if got != recorded:
        raise BundleError(f"{root / name} has changed: its SHA-256 is not the manifest's.", COPY_AGAIN)


def read_all(handle: int, size: int) -> bytes:
    """Read ``size`` bytes of an open file, or fewer when it ends; one more byte when it is longer."""
    parts = []
    left = size + 1
    while left and (part := os.read(handle, min(left, 64 * BLOCK))):
        parts.append(part)
        left -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def hash_handle(handle: int) -> str:
    """Return the SHA-256 of an open file from its start, as hex."""
    digest = hashlib.sha256()
    size = min(BLOCK, os.fstat(handle).st_size + 1)
    buffer, at = bytearray(size), 0  # one for all blocks: allocating takes longer than filling
    while count := os.preadv(handle, [buffer], at):
        digest.update(memoryview(buffer)[:count])
        at += count
    return digest.hexdigest()


@contextlib.contextmanager
def open_inside(root: Path, name: str) -> Iterator[int]:
    """Open a regular file of a bundle as ``open_regular`` does; raises BundleError where that raises OSError."""
    try:
        with open_regular(root, name) as handle:
            yield handle
    except OSError as error:
        raise _unreadable(root, name, error) from error


@contextlib.contextmanager
def open_regular(root: Path, name: str) -> Iterator[int]:
    """Open a regular file below ``root`` for reading, following no link, and yield its descriptor.

    Raises:
        OSError: when it is missing or not a regular file, or its path has a link.
    """
    folder, _, last = name.rpartition("/")
    with open_folder(root, folder) as parent:
        handle = os.open(last, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=parent)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.ELOOP, "it is not a regular file", str(root / name))
        yield handle
    finally:
        os.close(handle)


def _unreadable(root: Path, name: str, error: OSError) -> BundleError:
    if error.errno in (errno.ENOENT, errno.ELOOP, errno.ENOTDIR, errno.ENXIO, errno.EMLINK):
        return BundleError(f"The bundle {root} lacks the file {name} (missing, or a link).", COPY_AGAIN)
    return BundleError(f"{root / name} cannot be read: {error.strerror}.", COPY_AGAIN)


@contextlib.contextmanager
def open_folder(root: Path, folder: str) -> Iterator[int]:
    """Open a directory below ``root``, following no link below it, and yield its descriptor.

    Raises:
        OSError: when a part of the path is missing, a link, or not a directory.
    """
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
    handle = os.open(root, flags)
    try:
        for part in filter(None, folder.split("/")):
            inner = os.open(part, flags | os.O_NOFOLLOW, dir_fd=handle)
            os.close(handle)
            handle = inner
        yield handle
    finally:
        os.close(handle)


def find_unlisted(root: Path, listed: set[str], free: tuple[str, ...], folder: str) -> str:
    """Return the path of anything below ``root`` that is not listed, or nothing.

    Args:
        listed: relative paths that are expected.
        free: names of further regular files that may be at the top.
        folder: directory at the top that may contain regular files and directories of any name.
    """
    pending, seen = [""], 0
    while pending:
        inside = pending.pop()
        with os.scandir(root / inside) as entries:
            for entry in entries:
                name = f"{inside}/{entry.name}" if inside else entry.name
                seen += 1
                if seen > 2 * limit("files"):
                    return name
                if entry.is_dir(follow_symlinks=False):
                    pending.append(name)
                elif name not in listed and not (entry.is_file(follow_symlinks=False) and _exempt(name, free, folder)):
                    return name
    return ""


def _exempt(name: str, free: tuple[str, ...], folder: str) -> bool:
    return name in free or name.startswith(f"{folder}/") or name.rpartition("/")[2] in DESKTOP_FILES


@contextlib.contextmanager
def verified_directory(root: Path, folder: str, files: dict[str, tuple[str, int]]) -> Iterator[Path]:
    """Verify large files that an engine opens by name, and yield the directory under a path that cannot be replaced.

    When the block ends, files and directories must be unchanged since they were hashed: the same inodes under the same
    names, with the same time stamps.

    Args:
        folder: folder in which the engine opens files.
        files: relative path below ``root`` -> SHA-256 and size.

    Raises:
        BundleError: when a file differs from what was recorded, or anything changed before the block ended.
    """
    with contextlib.ExitStack() as stack:
        folders = {name.rpartition("/")[0] for name in files} | {folder}
        handles = {name: stack.enter_context(open_inside(root, name)) for name in files}
        try:
            directories = {name: stack.enter_context(open_folder(root, name)) for name in folders}
        except OSError as error:
            raise _unreadable(root, folder, error) from error
        watched = [*handles.values(), *directories.values()]
        _wait_for_clock_tick(watched)
        before = [_file_stamp(handle) for handle in watched]
        for name, (sha256, size) in files.items():
            check_size(root, name, handles[name], size)
            check_content(root, name, hash_handle(handles[name]), sha256)
        yield _descriptor_path(root, folder, directories[folder])
        same = before == [_file_stamp(handle) for handle in watched]
        if not same or not all(_still_there(name, handles, directories) for name in files):
            raise BundleError(f"The bundle {root} was changed while {', '.join(files)} was opened.", COPY_AGAIN)


def _descriptor_path(root: Path, folder: str, handle: int) -> Path:
    """Return a path of an open directory that stays valid when it is renamed."""
    path = Path(f"/proc/self/fd/{handle}")
    return path if path.is_dir() else root / folder


def _wait_for_clock_tick(handles: list[int]) -> None:
    """Wait until a further change would show in the time stamps."""
    newest = max(max(status.st_mtime_ns, status.st_ctime_ns) for status in map(os.fstat, handles))
    if 0 <= time.time_ns() - newest < TICK_NS:
        time.sleep(TICK_NS / 1e9)


def _file_stamp(handle: int) -> tuple[int, ...]:
    status = os.fstat(handle)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _still_there(name: str, handles: dict[str, int], directories: dict[str, int]) -> bool:
    folder, _, last = name.rpartition("/")
    try:
        entry = os.stat(last, dir_fd=directories[folder], follow_symlinks=False)
    except OSError:
        return False
    own = os.fstat(handles[name])
    return (entry.st_dev, entry.st_ino) == (own.st_dev, own.st_ino)
