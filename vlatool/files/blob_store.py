"""Large files that many stages share are stored once in the cache: ``files/SHA256``, with hard links to it.

Outside the cache no file shares its bytes with another one: a bundle that is written elsewhere is a copy (a clone where
the file system supports it), since editing a recording in it would otherwise edit every stage that has it. In the cache
such files are read-only, and the hashes of a stage are checked each time it is used.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import shutil
import uuid
from pathlib import Path

from vlatool.files.ownership import cache_hash, cached_hash
from vlatool.files.tree import files_below

TAG = "CACHEDIR.TAG"
SIGNATURE = "Signature: 8a477f597d28d172789f06886806bc55"
"""First line by which backup tools recognize a cache (https://bford.info/cachedir/)."""
TAG_TEXT = (
    f"{SIGNATURE}\n# This directory is vlatool's cache: 'vlatool cache size' and 'vlatool cache prune' look after it.\n"
)
STAGES, FILES, TRANSFERS = "stages", "files", "shipped"
MIN_SHARED_BYTES = 1 << 20
"""Size from which a file is shared."""
DIGEST = re.compile("[0-9a-f]{64}")
FICLONE = 0x40049409
READ_ONLY = 0o444
NO_LINK = (errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Errors of a hard link that is not supported, exceeds the limit on links, or crosses file systems."""
MAX_ATTEMPTS = 3


def mark_cache(cache: Path) -> None:
    """Mark a directory as vlatool's cache, if it can be written."""
    with contextlib.suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        with (cache / TAG).open("x", encoding="utf-8") as stream:
            stream.write(TAG_TEXT)


def is_cache(directory: Path) -> bool:
    """Return whether a directory is marked as vlatool's cache."""
    try:
        with (directory / TAG).open("rb") as stream:
            return stream.read(len(TAG_TEXT)) == TAG_TEXT.encode()
    except OSError:
        return False


def cache_containing(path: Path) -> Path | None:
    """Return the cache whose stages contain a path, else None."""
    above = (parent.parent for parent in Path(os.path.abspath(path)).parents if parent.name == STAGES)
    return next((parent for parent in above if is_cache(parent)), None)


def link_or_copy(source: Path, target: Path, sha256: str = "") -> None:
    """Give ``target`` the content of ``source``: links among the stages of a cache, else copies.

    Args:
        source: a file or a directory; a link leads to it.
        target: a new file or directory.
        sha256: SHA-256 of a file, where it is known.

    Raises:
        OSError: when the source cannot be read, or the target not be written.
    """
    if source.is_dir():
        for name, file in files_below(source).items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            link_or_copy(file, target / name)
        return
    source = source.resolve()
    share = source.stat().st_size >= MIN_SHARED_BYTES and (not sha256 or DIGEST.fullmatch(sha256))
    cache = cache_containing(target) if share else None
    if cache is None or not _link_blob(source, target, cache / FILES, sha256):
        clone(source, target)


def _link_blob(source: Path, target: Path, store: Path, sha256: str) -> bool:
    """Link the blob with that hash, storing it first if needed; return False where that is not possible."""
    sha256 = sha256 or cached_hash(source)
    for _ in range(MAX_ATTEMPTS):
        if not _has_hash(store / sha256, sha256) and not _store_blob(source, store, sha256):
            return False
        try:
            os.link(store / sha256, target)
        except FileNotFoundError:  # another process removed it, because no stage linked to it yet
            continue
        except OSError as error:
            if error.errno not in NO_LINK:
                raise
            return False
        cache_hash(target, sha256)
        return True
    return False


def _has_hash(path: Path, sha256: str) -> bool:
    try:
        return cached_hash(path) == sha256
    except OSError:
        return False


def _store_blob(source: Path, store: Path, sha256: str) -> bool:
    """Copy a file to ``store``; return False when its content changed meanwhile."""
    store.mkdir(exist_ok=True)
    draft = store / f".{sha256}.{os.getpid()}-{uuid.uuid4().hex[:8]}.part"
    try:
        clone(source, draft)
        draft.chmod(READ_ONLY)
        if cached_hash(draft) != sha256:
            return False
        os.replace(draft, store / sha256)
        cache_hash(store / sha256, sha256)
        return True
    finally:
        draft.unlink(missing_ok=True)


def clone(source: Path, target: Path) -> None:
    """Copy a file, sharing blocks (copy on write) where the file system supports it.

    Raises:
        OSError: when the source cannot be read, or the target cannot be written.
    """
    with source.open("rb") as read, target.open("wb") as write:
        try:
            fcntl.ioctl(write.fileno(), FICLONE, read.fileno())
            return
        except OSError:
            pass
    shutil.copyfile(source, target)
