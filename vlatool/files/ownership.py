"""A record of what vlatool wrote into a directory, file by file: nothing else is ever replaced or removed.

Each directory of ``vlatool.files.directory_writer`` has a ledger, ``.written-by-vlatool.json``: the name and the
SHA-256 of every file that was written. A directory without one is taken for a bundle if its manifest lists all other
files with these hashes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.errors import OutputError
from vlatool.files.verified_read import LEDGER as LEDGER
from vlatool.files.verified_read import hash_handle

MANIFEST = "manifest.json"
SCHEMA = 1
MAX_LEDGER_BYTES = 1 << 28
"""Size of the largest ledger or manifest that is read."""
MAX_SIDECAR = 4096
"""Size of the largest file beside a manifest that may contain the manifest's hash."""
CHANGED_REASON = "has been changed since vlatool wrote it"
FOREIGN_REASON = "was not written by vlatool"

FileStamp = tuple[int, int, int, int, int]
"""Device, inode, size, and the times of the last change of a file and of its inode in nanoseconds."""
_HASHES: dict[FileStamp, str] = {}
"""SHA-256 of files that this process has hashed."""


@dataclass(frozen=True)
class Listing:
    """Files that were written into a directory (name -> SHA-256), and its folders."""

    files: dict[str, str]
    folders: frozenset[str]

    @classmethod
    def of(cls, files: dict[str, str], folders: Iterable[str] = ()) -> Listing:
        """Return the listing of files and of every folder that contains them."""
        above = {str(parent) for name in files for parent in Path(name).parents}
        return cls(files, frozenset({*above, *folders} - {"."}))


@dataclass(frozen=True)
class Entry:
    """A file or folder below a directory: its relative path, and why vlatool did not write it (empty if it did)."""

    name: str
    folder: bool = False
    foreign: str = ""


def write_ledger(directory: Path) -> None:
    """Write the ledger of all files below a directory into it; raises OSError when reading or writing fails."""
    known = _records(_read_json(directory / MANIFEST)[0])
    files, folders = {}, []
    for path in sorted(directory.rglob("*")):
        name, status = path.relative_to(directory).as_posix(), path.lstat()
        if stat.S_ISDIR(status.st_mode):
            folders.append(name)
        elif stat.S_ISREG(status.st_mode) and name != LEDGER:
            digest, size = known.get(name, ("", -1))
            files[name] = digest if status.st_size == size else cached_hash(path)
    _write(directory, Listing.of(files, folders))


def add_to_ledger(path: Path) -> None:
    """Add a file to the ledger of its directory, if there is one."""
    folder = path.parent
    listing = _read_ledger(folder)
    if listing is not None:
        _write(folder, Listing.of({**listing.files, path.name: cached_hash(path)}, listing.folders))


def refuse_foreign(directory: Path) -> None:
    """Check that vlatool wrote every file below a directory, and that none was changed.

    Raises:
        OutputError: naming the first file that fails the check.
    """
    listing = read_listing(directory)
    if listing is None:
        first = min((entry.name for entry in os.scandir(directory)), default=None)
        if first is not None:
            raise OutputError(
                f"{directory} was not written by vlatool (it holds {first}), so --force does not replace it.", REMOVE
            )
        return
    for entry in walk(directory, listing):
        if entry.foreign:
            raise OutputError(f"{directory}/{entry.name} {entry.foreign}, so --force does not replace it.", REMOVE)


REMOVE = "choose another output, or move away what you want to keep and remove the rest yourself"


def remove_owned(directory: Path, *, changed: bool = False) -> bool:
    """Remove the files of a directory that vlatool wrote, one by one, and the folders that are then empty.

    Args:
        directory: directory that was moved aside.
        changed: whether to remove also files that were changed after vlatool wrote them.

    Returns:
        True when nothing of it is left.
    """
    listing = read_listing(directory)
    entries = [] if listing is None else list(walk(directory, listing))
    if not changed and any(entry.foreign for entry in entries):
        return False
    files = [entry.name for entry in entries if not entry.folder and entry.foreign in ("", CHANGED_REASON)]
    for name in sorted(files, key=lambda file: (file in (MANIFEST, LEDGER), file == LEDGER)):
        with contextlib.suppress(OSError):
            os.unlink(directory / name)
    for entry in entries:
        if entry.folder and not entry.foreign:
            with contextlib.suppress(OSError):
                os.rmdir(directory / entry.name)
    with contextlib.suppress(OSError):
        os.rmdir(directory)
    return not os.path.lexists(directory)


def walk(directory: Path, listing: Listing, below: str = "") -> Iterator[Entry]:
    """Yield every file and folder below a directory, folders after their content; foreign folders are not entered."""
    device = os.lstat(directory).st_dev
    try:
        with os.scandir(directory / below) as scanned:
            entries = sorted(scanned, key=lambda entry: entry.name)
    except OSError as error:
        yield Entry(below or ".", True, f"cannot be read ({error.strerror})")
        return
    for entry in entries:
        name = below + entry.name
        status = entry.stat(follow_symlinks=False)
        if not stat.S_ISDIR(status.st_mode):
            yield Entry(name, False, _foreign_file(directory / name, name, status.st_mode, listing))
        elif name not in listing.folders or status.st_dev != device:
            yield Entry(name, True, FOREIGN_REASON if status.st_dev == device else "is another file system")
        else:
            yield from walk(directory, listing, name + "/")
            yield Entry(name, True)


def _foreign_file(path: Path, name: str, mode: int, listing: Listing) -> str:
    """Return why a file is not one that vlatool wrote, empty when it is."""
    if not stat.S_ISREG(mode):
        return "is a link" if stat.S_ISLNK(mode) else "is not a regular file"
    if name == LEDGER:
        return "" if _read_ledger(path.parent) == listing else CHANGED_REASON
    if name not in listing.files:
        return FOREIGN_REASON
    try:
        return "" if cached_hash(path) == listing.files[name] else CHANGED_REASON
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def cached_hash(path: Path) -> str:
    """Return a file's SHA-256 as hex, hashed once while unchanged; raises OSError for a link or an unreadable file."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW), "rb") as stream:
        stamp = _stamp(os.fstat(stream.fileno()))
        if stamp not in _HASHES:
            digest = hash_handle(stream.fileno())
            if stamp != _stamp(os.fstat(stream.fileno())):
                return digest
            _HASHES[stamp] = digest
        return _HASHES[stamp]


def cache_hash(path: Path, sha256: str) -> None:
    """Remember the hash of a file that was renamed or linked after it was hashed, which changes its inode's times."""
    _HASHES[_stamp(os.lstat(path))] = sha256


def _stamp(status: os.stat_result) -> FileStamp:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def read_listing(directory: Path) -> Listing | None:
    """Return what vlatool wrote into a directory, None when there is no record of it."""
    return _read_ledger(directory) or _bundle_listing(directory)


def _read_ledger(directory: Path) -> Listing | None:
    data, content = _read_json(directory / LEDGER)
    files, folders = data.get("files"), data.get("folders", [])
    if data.get("schema") != SCHEMA or not isinstance(files, dict) or not isinstance(folders, list):
        return None
    if not all(isinstance(value, str) for value in (*files.values(), *folders)):
        return None
    listing = Listing.of(files, folders)
    return listing if content == _ledger_bytes(listing) else None


def _bundle_listing(directory: Path) -> Listing | None:
    """Return the files of a bundle without a ledger: the manifest's, the manifest, and a file with its hash."""
    data, content = _read_json(directory / MANIFEST)
    files = _records(data)
    if not files or not {"schema", "name", "spec"} <= set(data):
        return None
    if content != (json.dumps(data, indent=1, ensure_ascii=False) + "\n").encode():
        return None
    digest = hashlib.sha256(content).hexdigest()
    listed = {name: known for name, (known, _) in files.items()} | {MANIFEST: digest}
    for entry in os.scandir(directory):
        if entry.name not in listed and entry.is_file(follow_symlinks=False) and entry.stat().st_size <= MAX_SIDECAR:
            with contextlib.suppress(OSError):
                if Path(entry.path).read_bytes().split()[:1] == [digest.encode()]:
                    listed[entry.name] = cached_hash(Path(entry.path))
    return Listing.of(listed)


def _records(manifest: dict[str, Any]) -> dict[str, tuple[str, int]]:
    files = manifest.get("files")
    records = {}
    for name, record in files.items() if isinstance(files, dict) else ():
        match record:
            case {"sha256": str(digest), "bytes": int(size)}:
                records[name] = (digest, size)
            case _:
                return {}
    return records


def _read_json(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the mapping in a JSON file and the bytes of the file; both empty where there is no mapping."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as stream:
            content = stream.read(MAX_LEDGER_BYTES) if stat.S_ISREG(os.fstat(stream.fileno()).st_mode) else b""
        data = json.loads(content)
    except (OSError, ValueError, RecursionError):
        return {}, b""
    return (data, content) if isinstance(data, dict) else ({}, b"")


def _ledger_bytes(listing: Listing) -> bytes:
    """Return the only valid content of the ledger of a listing."""
    described = {
        "vlatool": "The files that vlatool wrote here, by SHA-256. --force replaces this directory only while it holds "
        "no other file and no file that was changed.",
        "schema": SCHEMA,
        "files": listing.files,
        "folders": sorted(listing.folders),
    }
    return (json.dumps(described, indent=1) + "\n").encode()


def _write(directory: Path, listing: Listing) -> None:
    draft = directory / f"{LEDGER}.{os.getpid()}.part"
    draft.write_bytes(_ledger_bytes(listing))
    os.replace(draft, directory / LEDGER)
