from __future__ import annotations

import fcntl
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from vlatool.errors import OutputError
from vlatool.files.user_files import DRAFT, atomic_file, remove_stamp, write_own_file


def test_the_draft_takes_the_place_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text("old")
    with atomic_file(file) as draft:
        draft.write_text("new")
        assert file.read_text() == "old"
        assert draft.parent == tmp_path
        assert draft.suffix != ".json", "a search for *.json must not find it"
    assert file.read_text() == "new"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file_and_no_draft(tmp_path: Path, error: type[BaseException]) -> None:
    file = tmp_path / "a.json"
    file.write_text("old")

    def fails() -> None:
        with atomic_file(file) as draft:
            draft.write_text("half")
            raise error

    with pytest.raises(error):
        fails()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "a.json")
    with atomic_file(tmp_path / "link.json") as draft:
        draft.write_text("new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "a.json").read_text() == "new"


def test_a_draft_that_was_not_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_file(tmp_path / "a.json"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_nobody_changed_is_replaced_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "deep/gate.yaml"
    write_own_file(path, "a: 1\n", force=False)
    assert yaml.safe_load(path.read_text()) == {"a": 1}
    with pytest.raises(OutputError, match="exists already"):
        write_own_file(path, "a: 2\n", force=False)
    write_own_file(path, "a: 2\n", force=True)
    assert remove_stamp(path.read_text()) == "a: 2\n"
    path.write_text(path.read_text().replace("2", "3", 1))
    with pytest.raises(OutputError, match="was changed since"):
        write_own_file(path, "a: 4\n", force=True)
    assert remove_stamp(path.read_text()) == "a: 3\n"


KILLED = """
import os, sys
from pathlib import Path
from vlatool.files.user_files import atomic_file
with atomic_file(Path(sys.argv[1])) as draft:
    draft.write_text("half")
    print(draft, flush=True)
    {}
"""


def begun(path: Path, then: str) -> tuple[subprocess.Popen[str], Path]:
    """Let another process begin to write a file; return it and its draft."""
    words = [sys.executable, "-c", KILLED.format(then), str(path)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


@pytest.mark.parametrize("name", ["a.json", "a [1].gif", ".hidden"])
def test_the_draft_of_a_killed_writer_is_removed_by_the_next(tmp_path: Path, name: str) -> None:
    killed, draft = begun(tmp_path / name, "os.kill(os.getpid(), 9)")
    killed.communicate()
    assert draft.read_text() == "half"
    with atomic_file(tmp_path / "another") as other:
        other.write_text("new")
    assert draft.exists(), "it is of another file"
    with atomic_file(tmp_path / name) as other:
        other.write_text("new")
    assert not draft.exists()
    assert (tmp_path / name).read_text() == "new"


def test_the_draft_of_a_living_writer_stays(tmp_path: Path) -> None:
    process, draft = begun(tmp_path / "a.json", "sys.stdin.readline()")
    with atomic_file(tmp_path / "a.json") as other:
        other.write_text("new")
    assert draft.exists()
    process.communicate("go on")
    assert (tmp_path / "a.json").read_text() == "half", "both were written whole, the last one stays"


@pytest.mark.parametrize(
    "name", [".a.json.12.part", ".a.json.vlatool-4194305.part", "a.json.vlatool-4194305-01234567.part"]
)
def test_what_is_only_called_like_a_draft_stays(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with atomic_file(tmp_path / "a.json") as draft:
        draft.write_text("new")
    assert (tmp_path / name).read_text() == "mine"


def test_a_draft_that_another_machine_writes_stays(tmp_path: Path) -> None:
    draft = tmp_path / DRAFT.format("a.json", 2**22 + 1, "0" * 8)
    draft.write_text("half")
    with draft.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with atomic_file(tmp_path / "a.json") as other:
            other.write_text("new")
        assert draft.exists(), "its process is not of this machine, and its lock is held"


@pytest.mark.parametrize("content", [b"", b"\n", b"mine", b"written by vlatool; SHA-256 of the lines above: ", b"\xff"])
def test_a_file_of_somebody_else_is_never_replaced(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(OutputError, match="was not written by vlatool"):
        write_own_file(tmp_path / "file", "a: 1\n", force=True)
    assert (tmp_path / "file").read_bytes() == content


@pytest.mark.parametrize("target", ["own", "nowhere"])
def test_nothing_is_written_through_a_link(tmp_path: Path, target: str) -> None:
    write_own_file(tmp_path / "own", "a: 1\n", force=False)
    (tmp_path / "link").symlink_to(target)
    for force in (False, True):
        with pytest.raises(OutputError, match="is a link"):
            write_own_file(tmp_path / "link", "a: 2\n", force=force)


@pytest.mark.parametrize("path", ["/proc/x.html", "/proc/self/x.npz"])
def test_a_file_that_cannot_be_created_is_named_not_its_draft(path: str):
    with pytest.raises(OSError, match=re.escape(f"'{path}'")), atomic_file(Path(path)):
        pass
