"""Where the trials of a study are kept: a journal or a database, looked at before anything is written there."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vlatool.errors import DataError, UsageError, VlatoolError, require
from vlatool.files.limits import LIMITS_VARIABLE, limit
from vlatool.files.printable import mask_passwords, secrets_in

EXAMPLES = "name a file, such as trials.journal, or a database, such as sqlite:///trials.db"
DRIVERS = {"psycopg": "psycopg[binary]", "psycopg2": "psycopg2-binary", "MySQLdb": "mysqlclient"}
"""Module -> the distribution that has it, where that is called otherwise."""
TABLES = {"studies", "trials", "trial_params", "version_info"}
"""Some of those that Optuna makes."""


def check_storage(url: str) -> None:
    """Refuse what cannot keep trials, without writing anything.

    Args:
        url: ``sqlite:///FILE``, ``mysql://``, ``postgresql://``, or a file for a journal.

    Raises:
        UsageError: for another kind of database, one whose driver is missing, or a file that cannot be.
        DataError: for a file that is not a journal, or a damaged one.
    """
    if not url.strip():
        raise UsageError("--study names no place.", EXAMPLES)
    if "://" in url:
        _check_database(url)
        return
    path = Path(url)
    if mask_passwords(url) != url and not path.exists():
        raise UsageError(f"The study {mask_passwords(url)} is neither a file nor an address of a database.", EXAMPLES)
    _check_file(path, url)
    if path.is_file():
        _sound_until(path)


def _check_database(url: str) -> None:
    require("optuna", "search")
    sqlalchemy = require("sqlalchemy", "search")
    shown = mask_passwords(url)
    try:
        made = sqlalchemy.engine.make_url(url)
        dialect = made.get_dialect()
    except (sqlalchemy.exc.ArgumentError, ValueError) as error:
        raise UsageError(f"The study {shown} is not the address of a known kind of database.", EXAMPLES) from error
    try:
        dialect.import_dbapi()
    except ImportError as error:
        driver = DRIVERS.get(error.name or "", error.name)
        raise UsageError(f"The study {shown} needs the Python package {driver}.", f"pip install '{driver}'") from error
    if made.get_backend_name() == "sqlite":
        if made.database in (None, "", ":memory:"):
            raise UsageError(f"The study {shown} would be in memory, and lost.", EXAMPLES)
        _check_file(Path(made.database), shown)
        _check_tables(Path(made.database), shown)


def _check_tables(path: Path, shown: str) -> None:
    """Refuse a database that is somebody else's: Optuna would write its tables among the others.

    Raises:
        DataError: when it holds tables, and those of a study are not among them; or it is not a database.
    """
    if not path.is_file() or not path.stat().st_size:
        return
    try:
        with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except sqlite3.Error as error:
        raise DataError(f"{shown} is not a database of trials: {error}.", EXAMPLES) from error
    if tables and not tables >= TABLES:
        others = ", ".join(sorted(tables - TABLES)[:3])
        raise DataError(f"{shown} is not a study: it is a database with the tables {others}.", "name a new file")


def _check_file(path: Path, shown: str) -> None:
    if path.is_dir():
        raise UsageError(f"The study {shown} is a folder.", f"name a file in it: {path / 'trials.journal'}")
    if not path.parent.is_dir():
        raise UsageError(f"The study {shown} is in a folder that does not exist.", f"create it: mkdir -p {path.parent}")


def _sound_until(path: Path) -> int:
    """Return how many bytes of a journal are whole lines, each of them a record.

    Raises:
        UsageError: when it cannot be read.
        DataError: when a line is something else; the last one may be torn.
    """
    sound = 0
    try:
        with path.open("rb") as lines:
            for number, line in enumerate(lines, 1):
                if not line.endswith(b"\n") and number > 1:
                    return sound
                if not _is_record(line):
                    _refuse_line(path, number)
                sound += len(line)
    except OSError as error:
        raise UsageError(f"The study {path} cannot be read: {error.strerror}.", EXAMPLES) from error
    return sound


def _is_record(line: bytes) -> bool:
    try:
        record = json.loads(line)
    except ValueError:
        return False
    return isinstance(record, dict) and "op_code" in record


def _refuse_line(path: Path, number: int) -> None:
    if number == 1:
        raise DataError(f"{path} is not a study: its first line is not a record of trials.", "name a new file")
    raise DataError(
        f"The study {path} is damaged: line {number} is not a record.",
        f"keep what is before it: head -n {number - 1} {path} > repaired.journal, and name that file",
    )


def storage_of(url: str) -> Any:
    """Return what Optuna opens: the address of a database, or a journal, whose torn last line is cut off.

    A process that is killed while it writes, or a full disk, leaves half a line: what follows would be glued to it.
    """
    if "://" in url:
        return url
    journal = require("optuna", "search").storages.journal
    lock = FileLock(Path(url))
    path = Path(url)
    if path.is_file() and path.stat().st_size:
        lock.acquire()
        try:
            sound = _sound_until(path)
            if sound < path.stat().st_size:
                with path.open("r+b") as torn:
                    torn.truncate(sound)
        finally:
            lock.release()
    return require("optuna", "search").storages.JournalStorage(journal.JournalFileBackend(url, lock))


class FileLock:
    """Keeps others from a file while a record is written; a process that ends, however, gives it up.

    ``flock`` on a file beside it, which also holds between machines that share an NFS. Optuna's own lock is a link that
    a killed process leaves.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.with_name(f"{path.name}.locked")
        self._handle = -1

    def acquire(self) -> bool:
        """Wait for the lock; raises UsageError when others hold it for ``study_seconds``, or it cannot be made."""
        try:
            handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise UsageError(f"The study cannot be locked: {self._path}: {error.strerror}.", EXAMPLES) from error
        end = time.monotonic() + limit("study_seconds")
        while not _locked(handle):
            if time.monotonic() > end:
                os.close(handle)
                raise UsageError(
                    f"Another process has held the lock {self._path} for {limit('study_seconds')} s.",
                    f"see which: fuser {self._path}; to wait longer: {LIMITS_VARIABLE}=study_seconds=600",
                )
            time.sleep(0.01)
        self._handle = handle
        return True

    def release(self) -> None:
        """Give it up."""
        os.close(self._handle)


def _locked(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextlib.contextmanager
def storage_errors(url: str) -> Iterator[None]:
    """Turn what Optuna and its databases raise of a study into a sentence that tells no password."""
    try:
        yield
    except (VlatoolError, MemoryError):
        raise
    except Exception as error:  # the seam: each database has errors of its own
        reason = (str(error).strip().splitlines()[:1] or [type(error).__name__])[0].rstrip(".")
        for secret in secrets_in(url):
            reason = reason.replace(secret, "***")
        raise UsageError(
            f"The study {mask_passwords(url)} cannot be used: {mask_passwords(reason)}.",
            "see that the place is there, and can be written; or take a new one: " + EXAMPLES.removeprefix("name "),
        ) from error
