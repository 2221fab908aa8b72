import json
import os
from pathlib import Path

import pytest

from vlatool.bundle.bundle import seal
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import OutputError
from vlatool.files.ownership import LEDGER, add_to_ledger, read_listing, refuse_foreign, remove_owned, write_ledger

MANIFEST = Manifest("tiny", "1.0.0", PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 2)),), 10.0))


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    """A directory that vlatool wrote."""
    folder = tmp_path / "ours"
    (folder / "graphs").mkdir(parents=True)
    (folder / "empty").mkdir()
    (folder / "graphs/main.onnx").write_bytes(b"weights")
    (folder / "report.json").write_text("{}")
    write_ledger(folder)
    return folder


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_was_written_is_ours_and_can_be_removed(ours: Path):
    refuse_foreign(ours)
    assert remove_owned(ours)
    assert not ours.exists()


def test_a_file_that_the_person_removed_is_not_missed(ours: Path):
    (ours / "report.json").unlink()
    refuse_foreign(ours)
    assert remove_owned(ours)


FOREIGN = {
    "graphs/notes.txt": lambda path: path.write_text("mine"),
    "report.json": lambda path: path.write_text("[]"),
    ".git": lambda path: path.mkdir(),
    "link": lambda path: path.symlink_to("/etc"),
    "pipe": lambda path: os.mkfifo(path),
    "graphs/more": lambda path: path.symlink_to("main.onnx"),
    LEDGER: lambda path: path.write_text(path.read_text() + "\n"),
    "manifest.json": lambda path: path.write_text('{"files": {}}'),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_one_foreign_thing_keeps_all_of_it(ours: Path, name: str):
    FOREIGN[name](ours / name)
    before = everything(ours) if name != "pipe" else None
    with pytest.raises(OutputError, match=f"ours/{name} |ours was not written") as caught:
        refuse_foreign(ours)
    assert "move away" in caught.value.fix
    assert not remove_owned(ours)
    assert os.path.lexists(ours / name)
    assert before is None or everything(ours) == before


def test_a_listed_file_behind_a_link_is_not_entered(ours: Path, tmp_path: Path):
    (ours / "graphs").rename(tmp_path / "graphs")
    (ours / "graphs").symlink_to(tmp_path / "graphs")
    with pytest.raises(OutputError, match="graphs is a link"):
        refuse_foreign(ours)
    assert not remove_owned(ours, changed=True)
    assert (tmp_path / "graphs/main.onnx").is_file()


def test_what_changed_goes_where_that_is_asked_for_and_what_is_foreign_stays(ours: Path):
    (ours / "report.json").write_text("damaged")
    (ours / "notes.txt").write_text("mine")
    assert not remove_owned(ours, changed=True)
    assert everything(ours) == {"notes.txt": b"mine"}


def test_a_file_that_is_written_later_is_noted(ours: Path):
    (ours / "gate.xml").write_text("<testsuites/>")
    add_to_ledger(ours / "gate.xml")
    refuse_foreign(ours)
    assert remove_owned(ours)


def test_noting_a_file_makes_no_directory_ours(tmp_path: Path):
    (tmp_path / "gate.xml").write_text("<testsuites/>")
    add_to_ledger(tmp_path / "gate.xml")
    assert os.listdir(tmp_path) == ["gate.xml"]


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """A bundle without a list, as one that was copied by its manifest."""
    (tmp_path / "bundle/graphs").mkdir(parents=True)
    (tmp_path / "bundle/graphs/main.onnx").write_bytes(b"weights")
    return seal(tmp_path / "bundle", MANIFEST).path


def test_a_bundle_without_a_list_is_known_by_its_manifest(bundle: Path):
    refuse_foreign(bundle)
    assert remove_owned(bundle)


@pytest.mark.parametrize("name", ["policy.py", "location.json", "graphs/other.onnx"])
def test_a_file_that_the_manifest_does_not_list_keeps_a_bundle(bundle: Path, name: str):
    (bundle / name).write_text("{}")
    with pytest.raises(OutputError, match=f"{name} was not written by vlatool"):
        refuse_foreign(bundle)


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "[]", "null", '{"files": {}}', '{"name": "my extension", "manifest_version": 3}', "[" * 100_000,
        '{"schema": 1, "name": "x", "spec": {}, "files": {"notes.txt": {"sha256": "0", "bytes": 1}}}',
    ],
)  # fmt: skip
def test_a_manifest_of_something_else_makes_no_directory_ours(tmp_path: Path, text: str):
    (tmp_path / "manifest.json").write_text(text)
    assert read_listing(tmp_path) is None
    with pytest.raises(OutputError, match="was not written by vlatool"):
        refuse_foreign(tmp_path)
    assert not remove_owned(tmp_path, changed=True)


@pytest.mark.parametrize(
    "data", [{}, {"schema": 2, "files": {}}, {"schema": 1, "files": []}, {"schema": 1, "files": {"notes.txt": 1}}]
)
def test_a_list_that_makes_no_sense_is_none(tmp_path: Path, data: dict[str, object]):
    (tmp_path / LEDGER).write_text(json.dumps(data))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError):
        refuse_foreign(tmp_path)


def test_an_empty_directory_is_in_nobodys_way(tmp_path: Path):
    refuse_foreign(tmp_path)


def test_a_name_out_of_the_directory_in_a_list_removes_nothing(tmp_path: Path):
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "out").mkdir()
    write_ledger(tmp_path / "out")
    data = json.loads((tmp_path / "out" / LEDGER).read_text())
    data["files"] = {"../precious": "0" * 64}
    (tmp_path / "out" / LEDGER).write_text(json.dumps({**data, "folders": [".."]}, indent=1) + "\n")
    remove_owned(tmp_path / "out", changed=True)
    assert (tmp_path / "precious").is_file()
