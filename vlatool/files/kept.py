"""Large files that many stages carry along are in the cache once: ``files/SHA256``, and hard links to it.

Outside of the cache no file shares its bytes with another one: a bundle that a person was given is a copy (which costs
nothing where the file system can clone), since who edits a recording in it would edit every stage that carries it. In
the cache such files are read-only, and every stage that is taken from there is held against its hashes.
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

from vlatool.files.tree import files_below
from vlatool.files.written import hash_once, note_seen

TAG = "CACHEDIR.TAG"
SIGNATURE = "Signature: 8a477f597d28d172789f06886806bc55"
"""What tells backups of a cache (https://bford.info/cachedir/)."""
TAGGED = (
    f"{SIGNATURE}\n# This directory is vlatool's cache: 'vlatool cache size' and 'vlatool cache prune' look after it.\n"
)
STAGES, FILES, SHIPPED = "stages", "files", "shipped"
SHARED = 1 << 20
"""Bytes from which a file is shared."""
DIGEST = re.compile("[0-9a-f]{64}")
FICLONE = 0x40049409
READ_ONLY = 0o444
NO_LINK = (errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS)
"""What a file system says that has no hard links, no more of them, or would have to reach into another one."""
ATTEMPTS = 3


def tag(cache: Path) -> None:
    """Mark a directory as vlatool's cache, as far as it can be written."""
    with contextlib.suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        with (cache / TAG).open("x", encoding="utf-8") as stream:
            stream.write(TAGGED)


def is_cache(directory: Path) -> bool:
    """Say whether a directory is marked as vlatool's cache."""
    try:
        with (directory / TAG).open("rb") as stream:
            return stream.read(len(TAGGED)) == TAGGED.encode()
    except OSError:
        return False


def cache_of(path: Path) -> Path | None:
    """Return the cache in whose stages a path lies, None when it lies in none."""
    above = (parent.parent for parent in Path(os.path.abspath(path)).parents if parent.name == STAGES)
    return next((place for place in above if is_cache(place)), None)


def carry(source: Path, target: Path, sha256: str = "") -> None:
    """Give ``target`` the content of ``source``: links among the stages of a cache, else copies.

    Args:
        source: A file or a directory; a link leads to it.
        target: A new file or directory.
        sha256: SHA-256 of a file, where it is known.

    Raises:
        OSError: when the source cannot be read, or the target not be written.
    """
    if source.is_dir():
        for name, file in files_below(source).items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            carry(file, target / name)
        return
    source = source.resolve()
    share = source.stat().st_size >= SHARED and (not sha256 or DIGEST.fullmatch(sha256))
    cache = cache_of(target) if share else None
    if cache is None or not _linked(source, target, cache / FILES, sha256):
        clone(source, target)


def _linked(source: Path, target: Path, kept: Path, sha256: str) -> bool:
    """Link the file of that content, once it is kept; False where that is not possible."""
    sha256 = sha256 or hash_once(source)
    for _ in range(ATTEMPTS):
        if not _is_sound(kept / sha256, sha256) and not _keep(source, kept, sha256):
            return False
        try:
            os.link(kept / sha256, target)
        except FileNotFoundError:  # another process removed it, since no stage had a link to it yet
            continue
        except OSError as error:
            if error.errno not in NO_LINK:
                raise
            return False
        note_seen(target, sha256)
        return True
    return False


def _is_sound(path: Path, sha256: str) -> bool:
    try:
        return hash_once(path) == sha256
    except OSError:
        return False


def _keep(source: Path, kept: Path, sha256: str) -> bool:
    """Copy a file to ``kept``; False when it is no longer what it was."""
    kept.mkdir(exist_ok=True)
    draft = kept / f".{sha256}.{os.getpid()}-{uuid.uuid4().hex[:8]}.part"
    try:
        clone(source, draft)
        draft.chmod(READ_ONLY)
        if hash_once(draft) != sha256:
            return False
        os.replace(draft, kept / sha256)
        note_seen(kept / sha256, sha256)
        return True
    finally:
        draft.unlink(missing_ok=True)


def clone(source: Path, target: Path) -> None:
    """Copy a file; where the file system can, both share their blocks until one is changed.

    Raises:
        OSError: when the source cannot be read, or the target not be written.
    """
    with source.open("rb") as read, target.open("wb") as write:
        try:
            fcntl.ioctl(write.fileno(), FICLONE, read.fileno())
            return
        except OSError:
            pass
    shutil.copyfile(source, target)
