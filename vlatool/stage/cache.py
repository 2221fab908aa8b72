"""The content and size of the cache, and how it is pruned.

Only what is recognisably vlatool's own is counted as an entry and ever removed: a finished stage by its name and the
list of its files, so what another machine sent, unfinished work by its lock, a count by its content, a shared
recording by its hash.
Everything else there is listed and left alone. What a running process uses is locked, and stays.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from vlatool.files.blob_store import DIGEST, FILES, STAGES, TAG, TRANSFERS
from vlatool.files.locks import exclusive_lock
from vlatool.files.ownership import LEDGER, cached_hash, read_listing
from vlatool.files.resumable_work import LOCK
from vlatool.files.user_files import DRAFT_NAME, remove_stale_drafts
from vlatool.graph.workload_file import is_workload

STREAMS, WORKLOADS = "streams", "workloads"
NAMES = {
    STAGES: re.compile(r"(?P<what>[a-z]+\.[a-z0-9_]+)-[0-9a-f]{16}"),
    STREAMS: re.compile(r"[\w.-]+"),
    WORKLOADS: re.compile(r"[0-9a-f]{32}\.json"),
    TRANSFERS: DIGEST,
}
STREAM_FILES = re.compile(
    r"lock|data|journal|answer-[0-9a-f]{32}\.json|checkpoint\.safetensors|meeting|round-\d{3}\.json"
    r"|(held-out/)?(expert/)?(round|draft)-\d{3}/.+|trials\.db(-journal)?"
)
"""What unfinished work is made of: a file that is written part by part, training, or the trials of ``optimize``."""
DRAFT = re.compile(r"\.(?P<final>.+)\.tmp-\d+-[0-9a-f]{8}")
PART = re.compile(r"\.[0-9a-f]{64}\.(?P<process>\d+)-[0-9a-f]{8}\.part")
MIN_AGE_S = 60.0
"""Seconds in which what was just made counts as in use: its maker has not locked it yet."""
IN_USE = "is in use"
RECENT = f"was made or used in the last {MIN_AGE_S:.0f} s"

Inode = tuple[int, int]


@dataclass(frozen=True)
class Entry:
    """One thing that the cache keeps.

    Args:
        name: below the cache.
        what: the stage's name; ``unfinished work``, ``count of a policy`` or ``files of another machine`` where it is
            not a stage.
        used: when it was last made or used, in seconds since 1970.
        files: relative name -> inode and bytes of the files that vlatool wrote.
    """

    name: str
    what: str
    used: float
    files: dict[str, tuple[Inode, int]]


@dataclass(frozen=True)
class Contents:
    """What a cache holds.

    Args:
        cache: where it is.
        entries: the least recently used one first.
        kept: shared files: name below the cache -> inode and bytes.
        unknown: names below the cache of what vlatool did not write, as far as it is beside entries.
    """

    cache: Path
    entries: tuple[Entry, ...]
    kept: dict[str, tuple[Inode, int]]
    unknown: tuple[str, ...] = ()

    @cached_property
    def uses(self) -> Counter[Inode]:
        """How many entries hold each file."""
        return Counter(inode for entry in self.entries for inode in {inode for inode, _ in entry.files.values()})

    @property
    def bytes(self) -> int:
        """Bytes of all files, one that entries share counted once."""
        sizes = {inode: size for entry in self.entries for inode, size in entry.files.values()}
        return sum({**sizes, **dict(self.kept.values())}.values())

    def sizes(self, entry: Entry) -> tuple[int, int]:
        """Return the bytes of an entry that are its own, and those that others have, too."""
        files = dict(entry.files.values())
        own = sum(size for inode, size in files.items() if self.uses[inode] == 1)
        return own, sum(files.values()) - own


@dataclass(frozen=True)
class Removed:
    """What was removed, or would be: entries, bytes that are free then, and why others stay (name -> reason)."""

    entries: tuple[Entry, ...]
    freed: int
    stays: dict[str, str]


def looks_like_cache(directory: Path) -> bool:
    """Return whether a directory is empty, or holds one of the folders of a cache."""
    return not any(directory.iterdir()) or any((directory / name).exists() for name in (*NAMES, FILES, TAG))


def contents(cache: Path) -> Contents:
    """Return what a cache holds; nothing for one that is not there yet; raises OSError when it cannot be read."""
    entries, unknown = [], []
    for folder in NAMES:
        for path in _children(cache / folder):
            try:
                entry = _entry(cache, folder, path)
            except FileNotFoundError:  # another process removed it since the folder was read
                continue
            if entry is not None:
                entries.append(entry)
            elif not DRAFT.fullmatch(path.name) and not _draft_of(folder, path.name):
                unknown.append(path.relative_to(cache).as_posix())
    kept, others = _shared_files(cache)
    unknown += others
    known = (*NAMES, FILES, TAG)
    unknown += [path.name for path in _children(cache) if path.name not in known]
    return Contents(cache, tuple(sorted(entries, key=lambda entry: entry.used)), kept, tuple(sorted(unknown)))


def _draft_of(folder: str, name: str) -> str:
    """Return which of a folder's files a draft is of; nothing where the name is that of no draft."""
    draft = DRAFT_NAME.fullmatch(name)
    return draft["final"] if draft and NAMES[folder].fullmatch(draft["final"]) else ""


def _shared_files(cache: Path) -> tuple[dict[str, tuple[Inode, int]], list[str]]:
    """Return the shared files by their names below the cache, and the names of what else is there."""
    kept, unknown = {}, []
    for path in _children(cache / FILES):
        name = path.relative_to(cache).as_posix()
        with contextlib.suppress(FileNotFoundError):
            status = path.lstat()
            if DIGEST.fullmatch(path.name) and stat.S_ISREG(status.st_mode):
                kept[name] = _inode(status)
            elif not PART.fullmatch(path.name):
                unknown.append(name)
    return kept, unknown


def prune(
    cache: Path, *, older_than_s: float | None = None, most_bytes: int | None = None, dry_run: bool = False
) -> Removed:
    """Remove entries, the least recently used first, and then the recordings that no entry holds any more.

    Args:
        older_than_s: age in seconds, since the last use, from which entries are removed; 0 for everything.
        most_bytes: size that the rest may have.
        dry_run: whether only to report what would be removed.
    """
    held = contents(cache)
    uses = Counter(held.uses)
    orphans = {inode: size for inode, size in held.kept.values() if not uses[inode]}
    left = held.bytes - sum(orphans.values())
    removed: list[Entry] = []
    stays: dict[str, str] = {}
    for entry in held.entries:
        old = older_than_s is not None and _now() - entry.used >= older_than_s
        if not old and (most_bytes is None or left <= most_bytes):
            continue
        reason = _remove(cache, entry, dry_run)
        if reason:
            stays[entry.name] = reason
        if not reason.startswith((IN_USE, RECENT)):
            removed.append(entry)
            files = dict(entry.files.values())
            uses.subtract(files.keys())
            left -= sum(size for inode, size in files.items() if not uses[inode])
    if not dry_run:
        stays |= _remove_unused(cache, [name for name, (inode, _) in held.kept.items() if not uses[inode]])
    return Removed(tuple(removed), held.bytes - left, stays)


def _now() -> float:
    """Return the time of day, as files have it."""
    return time.time_ns() / 1e9


def _children(folder: Path) -> list[Path]:
    if folder.is_symlink() or not folder.is_dir():
        return []
    return sorted(folder.iterdir())


def _inode(status: os.stat_result) -> tuple[Inode, int]:
    return (status.st_dev, status.st_ino), status.st_size


def _entry(cache: Path, folder: str, path: Path) -> Entry | None:
    """Return an entry of the cache, None for anything else."""
    named = NAMES[folder].fullmatch(path.name)
    status = path.lstat()
    if named is None or stat.S_ISLNK(status.st_mode):
        return None
    name = path.relative_to(cache).as_posix()
    if folder in (STAGES, TRANSFERS):
        what = named["what"] if folder == STAGES else "files of another machine"
        files = _stage_files(path)
        return Entry(name, what, status.st_mtime, files) if files else None
    if folder == STREAMS:
        files = _own_files(path, _is_of_a_stream) if (path / LOCK).is_file() else {}
        used = (path / LOCK).stat().st_mtime if files else 0.0
        return Entry(name, "unfinished work", used, files) if files else None
    if not stat.S_ISREG(status.st_mode) or not is_workload(path):
        return None
    return Entry(name, "count of a policy", status.st_mtime, {"": _inode(status)})


def _stage_files(path: Path) -> dict[str, tuple[Inode, int]]:
    listing = read_listing(path) if path.is_dir() else None
    return {} if listing is None else _own_files(path, {*listing.files, LEDGER}.__contains__)


def _is_of_a_stream(name: str) -> bool:
    """Say whether unfinished work is made of files of that name, or the file is a draft of one."""
    draft = DRAFT_NAME.fullmatch(name)
    return bool(STREAM_FILES.fullmatch(draft["final"] if draft else name))


def _own_files(path: Path, is_own: Callable[[str], object]) -> dict[str, tuple[Inode, int]]:
    """Return the regular files below a directory whose names are vlatool's, to which no link leads."""
    kept = {}
    for folder, _, files in os.walk(path):
        for file in files:
            name = Path(folder, file).relative_to(path).as_posix()
            with contextlib.suppress(FileNotFoundError):
                status = os.lstat(Path(folder, file))
                if is_own(name) and stat.S_ISREG(status.st_mode):
                    kept[name] = _inode(status)
    return kept


def _remove(cache: Path, entry: Entry, dry_run: bool) -> str:
    """Remove the files of an entry, file by file; return why something of it stays."""
    path = cache / entry.name
    if _now() - entry.used < MIN_AGE_S:
        return RECENT
    lock = path / LOCK if entry.what == "unfinished work" else path
    with exclusive_lock(lock) as mine:
        if not mine:
            return f"{IN_USE} by a running process"
        if dry_run:
            return ""
        for name in sorted(entry.files, key=lambda file: (file in (LEDGER, "manifest.json"), file == LEDGER)):
            with contextlib.suppress(FileNotFoundError):
                (path / name if name else path).unlink()
        for folder, _, _ in os.walk(path, topdown=False):
            with contextlib.suppress(OSError):  # not empty
                os.rmdir(folder)
    return "holds what vlatool did not write" if os.path.lexists(path) else ""


def _remove_unused(cache: Path, unused: Iterable[str]) -> dict[str, str]:
    """Remove shared files without links, and what killed writers left; return why something stays."""
    stays = {}
    for name in unused:
        with contextlib.suppress(FileNotFoundError):
            if (cache / name).lstat().st_nlink > 1:
                continue
            if cached_hash(cache / name) != Path(name).name:
                stays[name] = "is not what its name says"
            else:
                (cache / name).unlink()
    for path in _drafts(cache):
        path.unlink(missing_ok=True)
    return stays


def _drafts(cache: Path) -> Iterator[Path]:
    """Remove drafts of stages whose writers are gone; yield unfinished shared files of such writers."""
    for path in _children(cache / WORKLOADS):
        if final := _draft_of(WORKLOADS, path.name):
            remove_stale_drafts(path.with_name(final))
    for folder in (STAGES, TRANSFERS):
        for final in {match["final"] for path in _children(cache / folder) if (match := DRAFT.fullmatch(path.name))}:
            remove_stale_drafts(cache / folder / final)
    for path in _children(cache / FILES):
        match = PART.fullmatch(path.name)
        with contextlib.suppress(FileNotFoundError):
            if match and _is_stale(path.lstat(), match["process"]):
                yield path


def _is_stale(status: os.stat_result, process: str) -> bool:
    """Whether a draft's writer is gone; one in another container has no number here, so a draft must be old too."""
    old = _now() - status.st_mtime >= MIN_AGE_S
    return old and stat.S_ISREG(status.st_mode) and not Path(f"/proc/{process}").exists()
