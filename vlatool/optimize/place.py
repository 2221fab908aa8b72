"""Where the trials of a study are kept: a journal or a database, looked at before anything is written there."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vlatool.errors import DataError, UsageError, VlatoolError, require
from vlatool.files.printable import secrets_in, without_password

EXAMPLES = "name a file, such as trials.journal, or a database, such as sqlite:///trials.db"
DRIVERS = {"psycopg": "psycopg[binary]", "psycopg2": "psycopg2-binary", "MySQLdb": "mysqlclient"}
"""Module -> the distribution that has it, where that is called otherwise."""


def check_place(url: str) -> None:
    """Refuse what cannot keep trials, without writing anything.

    Args:
        url: ``sqlite:///FILE``, ``mysql://``, ``postgresql://``, or a file for a journal.

    Raises:
        UsageError: for another kind of database, one whose driver is missing, or a file that cannot be.
        DataError: for a file that is no journal, or a damaged one.
    """
    if not url.strip():
        raise UsageError("--study names no place.", EXAMPLES)
    if "://" in url:
        _check_database(url)
        return
    path = Path(url)
    if without_password(url) != url and not path.exists():
        raise UsageError(f"The study {without_password(url)} is neither a file nor an address of a database.", EXAMPLES)
    _check_file(path, url)
    if path.is_file():
        _sound_until(path)


def _check_database(url: str) -> None:
    require("optuna", "search")
    sqlalchemy = require("sqlalchemy", "search")
    shown = without_password(url)
    try:
        made = sqlalchemy.engine.make_url(url)
        dialect = made.get_dialect()
    except (sqlalchemy.exc.ArgumentError, ValueError) as error:
        raise UsageError(f"The study {shown} is no address of a database that is known here.", EXAMPLES) from error
    try:
        dialect.import_dbapi()
    except ImportError as error:
        driver = DRIVERS.get(error.name or "", error.name)
        raise UsageError(f"The study {shown} needs the Python package {driver}.", f"pip install '{driver}'") from error
    if made.get_backend_name() == "sqlite":
        if made.database in (None, "", ":memory:"):
            raise UsageError(f"The study {shown} would be in memory, and lost.", EXAMPLES)
        _check_file(Path(made.database), shown)


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
        raise DataError(f"{path} is not a study: its first line is no record of trials.", "name a new file")
    raise DataError(
        f"The study {path} is damaged: line {number} is no record.",
        f"keep what is before it: head -n {number - 1} {path} > repaired.journal, and name that file",
    )


def storage_of(url: str) -> Any:
    """Return what Optuna opens: the address of a database, or a journal, whose torn last line is cut off.

    A process that is killed while it writes, or a full disk, leaves half a line: what follows would be glued to it.
    """
    if "://" in url:
        return url
    journal = require("optuna", "search").storages.journal
    lock = journal.JournalFileSymlinkLock(url)
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


@contextlib.contextmanager
def used(url: str) -> Iterator[None]:
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
            f"The study {without_password(url)} cannot be used: {without_password(reason)}.",
            "see that the place is there, and can be written; or take a new one: " + EXAMPLES.removeprefix("name "),
        ) from error
