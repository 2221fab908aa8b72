"""Where trials are kept: what cannot keep them is refused before anything is written, and no password is told."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import subprocess
import sys
from pathlib import Path

import optuna
import pytest

from vlatool.errors import DataError, UsageError
from vlatool.optimize.study_storage import FileLock, check_storage, storage_of

RECORD = json.dumps({"op_code": 0, "worker_id": "x", "study_name": "s", "directions": [1]}) + "\n"


def journal(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(("url", "says", "fix"), [
    ("  ", "--study names no place", "name a file"),
    ("{tmp}", "is a folder", "name a file in it"),
    ("{tmp}/none/x.journal", "in a folder that does not exist", "mkdir -p"),
    ("sqlite:///{tmp}/none/x.db", "in a folder that does not exist", "mkdir -p"),
    ("sqlite:///{tmp}", "is a folder", "name a file in it"),
    ("sqlite://", "would be in memory", "sqlite:///trials.db"),
    ("sqlite:///:memory:", "would be in memory", "sqlite:///trials.db"),
    ("redis://host/0", "not the address of a known kind of database", "sqlite:///trials.db"),
    ("postgresql://me:secret@host:x/db", "not the address of a known kind of database", "sqlite:///trials.db"),
    ("postgresql+none://me:secret@host/db", "not the address of a known kind of database", "sqlite:///trials.db"),
    ("postgresql:/me:secret@host/db", "neither a file nor an address", "name a file"),
])  # fmt: skip
def test_what_keeps_no_trials_is_refused_with_what_helps(tmp_path: Path, url: str, says: str, fix: str):
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UsageError, match=says) as caught:
        check_storage(url.format(tmp=tmp_path))
    assert fix in str(caught.value.fix)
    assert "secret" not in f"{caught.value} {caught.value.fix}"
    assert sorted(tmp_path.rglob("*")) == before


def test_a_missing_driver_is_named(monkeypatch: pytest.MonkeyPatch):
    from sqlalchemy.dialects.postgresql.psycopg2 import PGDialect_psycopg2

    def missing() -> None:
        raise ModuleNotFoundError("No module named 'psycopg2'", name="psycopg2")

    monkeypatch.setattr(PGDialect_psycopg2, "import_dbapi", missing)
    with pytest.raises(UsageError, match=r"me:\*\*\*@host/db needs the Python package psycopg2-binary"):
        check_storage("postgresql+psycopg2://me:secret@host/db")


@pytest.mark.parametrize("text", ["keep me", "garbage {\n", "[1]\n", "{}\n", "\n", "two\nlines\n"])
def test_a_file_that_is_no_study_stays_as_it_is(tmp_path: Path, text: str):
    url = journal(tmp_path / "mine.txt", text)
    for use in (check_storage, storage_of):
        with pytest.raises(DataError, match="is not a study: its first line is not a record"):
            use(url)
        assert Path(url).read_text() == text


def test_a_damaged_line_is_named(tmp_path: Path):
    url = journal(tmp_path / "trials.journal", RECORD + "{broken\n" + RECORD)
    with pytest.raises(DataError, match="is damaged: line 2 is not a record") as caught:
        check_storage(url)
    assert "head -n 1" in str(caught.value.fix)


@pytest.mark.parametrize("torn", ["", RECORD[:-1], RECORD[:9], "{"])
def test_a_torn_last_line_is_cut_off_before_anything_follows_it(tmp_path: Path, torn: str):
    url = journal(tmp_path / "trials.journal", 2 * RECORD + torn)
    check_storage(url)
    assert Path(url).read_text() == 2 * RECORD + torn, "looking changes nothing"
    storage_of(url)
    assert Path(url).read_text() == 2 * RECORD


@pytest.mark.parametrize("name", ["new.journal", "empty.journal"])
def test_new_and_empty_files_are_places(tmp_path: Path, name: str):
    (tmp_path / "empty.journal").touch()
    check_storage(str(tmp_path / name))
    check_storage(f"sqlite:///{tmp_path / 'trials.db'}")
    assert [path.name for path in tmp_path.iterdir()] == ["empty.journal"]


def test_a_lock_that_a_killed_process_left_is_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """By a relative path, as well: Optuna's own lock is a link, and one to a relative path waits for ever."""
    monkeypatch.chdir(tmp_path)
    Path("sub").mkdir()
    Path("sub/t.journal.lock").symlink_to("sub/t.journal")
    code = "import os, sys; from vlatool.optimize.study_storage import FileLock; from pathlib import Path; "
    code += "FileLock(Path('sub/t.journal')).acquire(); os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    study = optuna.create_study(storage=storage_of("sub/t.journal"), study_name="one")
    study.add_trial(optuna.trial.create_trial(value=1.0))
    assert len(optuna.load_study(storage=storage_of("sub/t.journal"), study_name="one").trials) == 1


def test_a_lock_that_is_held_is_named_after_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "study_seconds=1")
    held = FileLock(tmp_path / "t.journal")
    held.acquire()
    with pytest.raises(UsageError, match=r"has held the lock .*t\.journal\.locked for 1 s") as caught:
        FileLock(tmp_path / "t.journal").acquire()
    assert "study_seconds" in caught.value.fix
    held.release()
    other = FileLock(tmp_path / "t.journal")
    assert other.acquire()
    other.release()


def test_a_database_of_others_is_left_alone(tmp_path: Path):
    with contextlib.closing(sqlite3.connect(tmp_path / "notes.db")) as database:
        database.execute("CREATE TABLE notes (text)")
        database.commit()
    with pytest.raises(DataError, match="is not a study: it is a database with the tables notes"):
        check_storage(f"sqlite:///{tmp_path / 'notes.db'}")
    (tmp_path / "text.db").write_text("nothing of the kind" * 100)
    with pytest.raises(DataError, match="is not a database of trials"):
        check_storage(f"sqlite:///{tmp_path / 'text.db'}")
    url = f"sqlite:///{tmp_path / 'trials.db'}"
    for _ in range(2):
        check_storage(url)
        optuna.create_study(storage=storage_of(url), study_name="one", load_if_exists=True)
