"""Transfer of folders to other machines: named by the hash of their content, and complete or absent there."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import stat
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from vlatool.errors import OutputError, SourceError
from vlatool.files.blob_store import TRANSFERS, mark_cache
from vlatool.files.directory_writer import write_directory
from vlatool.files.limits import check_limit
from vlatool.files.locks import acquire
from vlatool.files.ownership import cached_hash
from vlatool.machine.host import cache_directory
from vlatool.user_code.walk import files_below
from vlatool.workers import Folder

READABLE = "see that this user may read it, and that its disk is well"

BLOCK_BYTES = 1 << 26
"""Bytes that are sent at a time."""
READ_BYTES = 1 << 20


@dataclass(frozen=True)
class TransferFile:
    """A file: its name in the folder, SHA-256, bytes, and whether it may be executed."""

    name: str
    sha256: str
    size: int
    runs: bool = False


@dataclass(frozen=True)
class Parcel:
    """What of a folder is sent.

    Args:
        folder: where it is on the machine that sends it, absolute.
        files: files in the order in which they are sent.
    """

    folder: str
    files: tuple[TransferFile, ...]

    @property
    def digest(self) -> str:
        """The hash of names and contents: what the folder is called elsewhere."""
        told = [[file.name, file.sha256, file.runs] for file in self.files]
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()

    @property
    def place(self) -> Path:
        """Where it is on this machine once it has arrived."""
        return cache_directory() / TRANSFERS / self.digest

    def is_here(self) -> bool:
        """Say whether every file has arrived, and is what it was; then it stays while this process runs."""
        with contextlib.suppress(OSError):
            held = acquire(self.place)
            return held and all(cached_hash(self.place / file.name) == file.sha256 for file in self.files)
        return False


def parcel_of(folder: Folder) -> Parcel:
    """List the files of a folder that are sent, within the limit on their number."""
    root = Path(folder.path)
    try:
        paths = [root / name for name in folder.names] or list(_has_few_files(root))
        files = tuple(_transfer_file(path, path.relative_to(root).as_posix()) for path in paths)
    except OSError as error:
        raise SourceError(
            f"{error.filename or root} cannot be sent to the workers: {error.strerror}.", READABLE
        ) from error
    size = sum(file.size for file in files)
    check_limit("shipped_bytes", size, f"{root}, which is sent to the workers,", SourceError)
    return Parcel(folder.path, files)


def _has_few_files(root: Path) -> Iterator[Path]:
    for count, path in enumerate(files_below(root), 1):
        check_limit("shipped_files", count, f"{root}, which is sent to the workers,", SourceError)
        yield path


def _transfer_file(path: Path, name: str) -> TransferFile:
    path = path.resolve()
    status = path.stat()
    return TransferFile(name, cached_hash(path), status.st_size, bool(status.st_mode & stat.S_IXUSR))


def blocks(parcel: Parcel) -> Iterator[bytes]:
    """Yield the contents of all files, one after the other, in blocks; at least one."""
    waiting = bytearray()
    for file in parcel.files:
        path, left = Path(parcel.folder, file.name), file.size
        try:
            with path.open("rb") as stream:
                while more := stream.read(min(READ_BYTES, left)):
                    left -= len(more)
                    waiting += more
                    if len(waiting) >= BLOCK_BYTES:
                        yield bytes(waiting)
                        waiting.clear()
        except OSError as error:
            raise SourceError(f"{path} cannot be sent to the workers: {error.strerror}.", READABLE) from error
        if left:
            raise SourceError(f"{path} has changed while it was sent to the workers.", "run the command again")
    yield bytes(waiting)


class IncomingParcel:
    """A parcel that is being written into the cache of this machine."""

    def __init__(self, parcel: Parcel) -> None:
        self._parcel = parcel
        self._opened = contextlib.ExitStack()
        mark_cache(cache_directory())
        damaged = os.path.lexists(parcel.place)
        self._draft: Path = self._opened.enter_context(write_directory(parcel.place, damaged=damaged))
        self._files = iter(parcel.files)
        self._stream: BinaryIO | None = None
        self._left = 0

    def add(self, block: bytes) -> None:
        """Write the next block."""
        while block or not self._left:
            if not self._left and not self._next():
                return
            part, block = block[: self._left], block[self._left :]
            if self._stream is not None:
                self._stream.write(part)
            self._left -= len(part)

    def abandon(self, error: BaseException) -> None:
        """Remove what has arrived, since it cannot be completed."""
        self._close()
        with contextlib.suppress(type(error), OSError, OutputError):
            self._opened.__exit__(type(error), error, error.__traceback__)

    def end(self) -> None:
        """Give the folder its name, if what arrived is what was sent."""
        self._close()
        try:
            for file in self._parcel.files:
                (self._draft / file.name).chmod(0o755 if file.runs else 0o644)
            self._opened.close()
        except OutputError:  # another worker of this machine was faster
            if not self._parcel.is_here():
                raise
        if not self._parcel.is_here():
            raise OutputError(f"{self._parcel.place} is not what was sent.", "run the command again")

    def _next(self) -> bool:
        """Begin the next file; say whether there is one."""
        self._close()
        file = next(self._files, None)
        if file is None:
            return False
        path = self._draft / file.name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream, self._left = path.open("wb"), file.size
        return True

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()
        self._stream = None


class PathTranslation:
    """The names of folders, here -> there: each path in a text is that of the other side."""

    def __init__(self, pairs: Sequence[tuple[str, str]]) -> None:
        self._pairs = sorted(pairs, key=lambda pair: -len(pair[0]))  # a folder in another one first

    def translate(self, value: object) -> object:
        """Return JSON values in which every text that is a path in a folder is that path on the other side."""
        return _map_texts(value, self._translate_path)

    def _translate_path(self, text: str) -> str:
        return next((there + text[len(here) :] for here, there in self._pairs if _is_in(text, here)), text)

    def rewrite(self, value: object) -> object:
        """Return JSON values in which the paths are those of the other side wherever a text mentions them."""
        return _map_texts(value, lambda text: functools.reduce(lambda new, pair: new.replace(*pair), self._pairs, text))


def _map_texts(value: object, change: Callable[[str], str]) -> object:
    """Return JSON values with every text changed, but for the keys of mappings."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {key: _map_texts(item, change) for key, item in value.items()}
    return [_map_texts(item, change) for item in value] if isinstance(value, list) else value


def _is_in(text: str, folder: str) -> bool:
    return text == folder or text.startswith(f"{folder.rstrip('/')}/")
