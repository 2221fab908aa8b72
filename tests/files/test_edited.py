from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from vlatool.errors import OutputError
from vlatool.files.edited import unstamped, whole_file, write_own


def test_the_draft_takes_the_place_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text("old")
    with whole_file(file) as draft:
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
        with whole_file(file) as draft:
            draft.write_text("half")
            raise error

    with pytest.raises(error):
        fails()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "a.json")
    with whole_file(tmp_path / "link.json") as draft:
        draft.write_text("new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "a.json").read_text() == "new"


def test_a_draft_that_was_not_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), whole_file(tmp_path / "a.json"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_nobody_changed_is_replaced_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "deep/gate.yaml"
    write_own(path, "a: 1\n", force=False)
    assert yaml.safe_load(path.read_text()) == {"a": 1}
    with pytest.raises(OutputError, match="exists already"):
        write_own(path, "a: 2\n", force=False)
    write_own(path, "a: 2\n", force=True)
    assert unstamped(path.read_text()) == "a: 2\n"
    path.write_text(path.read_text().replace("2", "3", 1))
    with pytest.raises(OutputError, match="was changed since"):
        write_own(path, "a: 4\n", force=True)
    assert unstamped(path.read_text()) == "a: 3\n"


@pytest.mark.parametrize("content", [b"", b"\n", b"mine", b"written by vlatool; SHA-256 of the lines above: ", b"\xff"])
def test_a_file_of_somebody_else_is_never_replaced(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(OutputError, match="was not written by vlatool"):
        write_own(tmp_path / "file", "a: 1\n", force=True)
    assert (tmp_path / "file").read_bytes() == content


@pytest.mark.parametrize("target", ["own", "nowhere"])
def test_nothing_is_written_through_a_link(tmp_path: Path, target: str) -> None:
    write_own(tmp_path / "own", "a: 1\n", force=False)
    (tmp_path / "link").symlink_to(target)
    for force in (False, True):
        with pytest.raises(OutputError, match="is a link"):
            write_own(tmp_path / "link", "a: 2\n", force=force)
