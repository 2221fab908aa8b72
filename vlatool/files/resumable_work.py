"""Long work whose progress is stored in the cache, so that a killed run can be resumed."""

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

from vlatool.files.locks import exclusive_lock, is_same_file
from vlatool.files.printable import file_of
from vlatool.files.user_files import add_stamp, atomic_file, is_own_file

LOCK = "lock"
MAX_AGE_S = 7 * 24 * 3600
"""Age in seconds at which unfinished work is removed."""
ANSWER = "answer-{}.json"


@contextlib.contextmanager
def work_directory(folder: Path) -> Iterator[Path]:
    """Yield the directory of unfinished work, locked: one run at a time resumes it, others wait."""
    with _lock(folder, fcntl.LOCK_EX):
        yield folder


@contextlib.contextmanager
def _lock(folder: Path, how: int) -> Iterator[None]:
    handle = _wait_for_lock(folder, how)
    try:
        os.utime(folder / LOCK)
        yield
    finally:
        os.close(handle)


def _wait_for_lock(folder: Path, how: int) -> int:
    """Wait for the lock of a work directory, which the run that held it may have removed and another one recreated."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        _remove_old_work(folder)
        handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, how)
            if is_same_file(handle, os.fspath(folder / LOCK)):
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def remove_work(folder: Path) -> None:
    """Remove a work directory whose result was written."""
    shutil.rmtree(folder, ignore_errors=True)


def _remove_old_work(folder: Path) -> None:
    """Remove other work that was not resumed for a week."""
    for other in folder.parent.iterdir():
        with contextlib.suppress(OSError):
            if other == folder or time.time_ns() / 1e9 - (other / LOCK).stat().st_mtime < MAX_AGE_S:
                continue
            remove_if_unused(other)


def remove_if_unused(folder: Path) -> None:
    """Remove a work directory, unless another run uses it (which then removes it itself)."""
    with exclusive_lock(folder / LOCK) as free:
        if free:
            remove_work(folder)


def remove_all_unused(folders: Iterable[Path]) -> None:
    """Remove the work directories of a result that was written, except those that another run uses."""
    for folder in folders:
        remove_if_unused(folder)


class Store:
    """Finished parts of a run: key -> JSON value, each in a file that is written atomically.

    Several runs may use it at a time. Where it cannot be written, the run goes on without it, and ``problem`` says why.
    """

    def __init__(self, folder: Path) -> None:
        self.place = folder
        self.problem = ""
        self.taken = 0
        """Number of items (such as episodes) that were taken from an earlier run; the caller counts them."""
        self.asked = 0
        """Number of items in total."""
        self._key_uses: Counter[str] = Counter()

    @classmethod
    @contextlib.contextmanager
    def open(cls, folder: Path) -> Iterator[Store]:
        """Yield the store of a folder, which no other process removes while it is open."""
        store = cls(folder)
        with contextlib.ExitStack() as opened:
            try:
                opened.enter_context(_lock(folder, fcntl.LOCK_SH))
            except OSError as error:
                store._note_problem(error)
            yield store

    def turn(self, key: str) -> str:
        """Return a key that is unique in this run: a run must not take its own results for those of an earlier one.

        Every run of a command asks for the same keys in the same order, so an interrupted run can be resumed.
        """
        self._key_uses[key] += 1
        return key if self._key_uses[key] == 1 else f"{key} ({self._key_uses[key]})"

    def get(self, key: str) -> Any:
        """Return the value of a key; None where there is none, or its file was damaged or changed."""
        try:
            path = self._file(key)
            if not is_own_file(path):
                return None
            entry = json.loads(path.read_text(encoding="utf-8").partition("\n")[0])
        except (OSError, ValueError, RecursionError):
            return None
        return entry["value"] if isinstance(entry, dict) and entry.get("key") == key else None

    def put(self, key: str, value: Any) -> None:
        """Store a value that is not None."""
        if self.problem:
            return
        try:
            self.place.mkdir(parents=True, exist_ok=True)
            with atomic_file(self._file(key)) as draft:
                draft.write_text(add_stamp(json.dumps({"key": key, "value": value}) + "\n"), encoding="utf-8")
        except OSError as error:
            self._note_problem(error)

    def drop(self, key: str) -> None:
        """Remove the value of a key."""
        with contextlib.suppress(OSError):
            self._file(key).unlink(missing_ok=True)

    def _file(self, key: str) -> Path:
        return self.place / ANSWER.format(hashlib.sha256(key.encode()).hexdigest()[:32])

    def _note_problem(self, error: OSError) -> None:
        where = file_of(error) or self.place
        self.problem = (
            f"Finished work cannot be stored, so a run that is interrupted would start over: {where}: "
            f"{error.strerror or error}; free some space there, or name another cache (VLATOOL_CACHE)."
        )
