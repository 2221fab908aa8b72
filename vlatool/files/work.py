"""Work that takes long, kept in the cache so that a run that is killed goes on."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from vlatool.files.edited import is_own, stamped, whole_file
from vlatool.files.locks import is_at
from vlatool.files.printable import file_of

LOCK = "lock"
FORGOTTEN_S = 7 * 24 * 3600
"""Age in seconds from which unfinished work that nobody continues is removed."""
ANSWER = "answer-{}.json"


@contextlib.contextmanager
def work_directory(place: Path) -> Iterator[Path]:
    """Yield the directory of unfinished work, locked: one run at a time continues it, others wait."""
    with _locked(place, fcntl.LOCK_EX):
        yield place


@contextlib.contextmanager
def _locked(place: Path, how: int) -> Iterator[None]:
    handle = _lock_of(place, how)
    try:
        os.utime(place / LOCK)
        yield
    finally:
        os.close(handle)


def _lock_of(place: Path, how: int) -> int:
    """Wait for the lock of a work directory; a run that had it may have removed both, and others have made it anew."""
    while True:
        place.mkdir(parents=True, exist_ok=True)
        _sweep(place)
        handle = os.open(place / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, how)
            if is_at(handle, os.fspath(place / LOCK)):
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def forget(place: Path) -> None:
    """Remove a work directory whose result has arrived."""
    shutil.rmtree(place, ignore_errors=True)


def _sweep(place: Path) -> None:
    """Remove other work that nobody has continued for a week."""
    for other in place.parent.iterdir():
        with contextlib.suppress(OSError):
            if other == place or time.time_ns() / 1e9 - (other / LOCK).stat().st_mtime < FORGOTTEN_S:
                continue
            forget_unused(other)


def forget_unused(place: Path) -> None:
    """Remove a work directory, unless another run uses it, which then removes it itself.

    Raises:
        OSError: when it is used, or there is none.
    """
    handle = os.open(place / LOCK, os.O_RDWR)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        forget(place)
    finally:
        os.close(handle)


def forget_all(places: Iterable[Path]) -> None:
    """Remove the work directories of a result that was written, as far as no other run uses them."""
    for place in places:
        with contextlib.suppress(OSError):
            forget_unused(place)


class Store:
    """Finished parts of a run: key -> JSON value, each in a file that is written whole or not at all.

    Several runs may use one at a time. What cannot be written is not kept, and ``problem`` says so: it is there for a
    run that is killed, and this one does without.

    Args:
        place: Its folder.
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        self.problem = ""
        self.taken = 0
        """How many things (episodes, say) were taken from an earlier run; counted by whoever takes them."""
        self.asked = 0
        """How many there are in all."""
        self._turns: Counter[str] = Counter()

    @classmethod
    @contextlib.contextmanager
    def open(cls, place: Path) -> Iterator[Store]:
        """Yield the store of a folder, which no other process removes meanwhile."""
        store = cls(place)
        with contextlib.ExitStack() as opened:
            try:
                opened.enter_context(_locked(place, fcntl.LOCK_SH))
            except OSError as error:
                store._failed(error)
            yield store

    def turn(self, key: str) -> str:
        """Return the key for what a run does once more under one that it had: a run never takes what is its own.

        Every run of a command does the same in the same order, so that an interrupted one is gone on with.
        """
        self._turns[key] += 1
        return key if self._turns[key] == 1 else f"{key} ({self._turns[key]})"

    def get(self, key: str) -> Any:
        """Return what is kept under a key, None for nothing; what was damaged or changed counts as nothing."""
        try:
            path = self._file(key)
            if not is_own(path):
                return None
            kept = json.loads(path.read_text(encoding="utf-8").partition("\n")[0])
        except (OSError, ValueError, RecursionError):
            return None
        return kept["value"] if isinstance(kept, dict) and kept.get("key") == key else None

    def put(self, key: str, value: Any) -> None:
        """Keep a value that is not None."""
        if self.problem:
            return
        try:
            self.place.mkdir(parents=True, exist_ok=True)
            with whole_file(self._file(key)) as draft:
                draft.write_text(stamped(json.dumps({"key": key, "value": value}) + "\n"), encoding="utf-8")
        except OSError as error:
            self._failed(error)

    def drop(self, key: str) -> None:
        """Keep nothing under a key any more."""
        with contextlib.suppress(OSError):
            self._file(key).unlink(missing_ok=True)

    def _file(self, key: str) -> Path:
        return self.place / ANSWER.format(hashlib.sha256(key.encode()).hexdigest()[:32])

    def _failed(self, error: OSError) -> None:
        where = file_of(error) or self.place
        self.problem = (
            f"What is finished cannot be kept, so a run that is interrupted would begin again: {where}: "
            f"{error.strerror or error}; make room there, or name another cache (VLATOOL_CACHE)."
        )
