import errno
import os
from pathlib import Path

import pytest

from vlatool.files import atomic_rename
from vlatool.files.atomic_rename import exchange, rename_to_new


@pytest.fixture(params=["renameat2", "without it"])
def system(request, monkeypatch) -> str:
    if request.param == "without it":
        monkeypatch.setattr(atomic_rename, "_rename", lambda *_arguments: False)
    return request.param


def test_a_directory_moves_to_a_free_name(tmp_path: Path, system):
    (tmp_path / "new/deep").mkdir(parents=True)
    rename_to_new(tmp_path / "new", tmp_path / "out")
    assert (tmp_path / "out/deep").is_dir()
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("kind", ["empty", "full", "file", "link", "dangling"])
def test_a_name_that_is_taken_is_never_replaced(tmp_path: Path, system, kind: str):
    out = tmp_path / "out"
    (tmp_path / "new").mkdir()
    {
        "empty": lambda: out.mkdir(),
        "full": lambda: (out / "deep").mkdir(parents=True),
        "file": lambda: out.touch(),
        "link": lambda: out.symlink_to(tmp_path),
        "dangling": lambda: out.symlink_to("nowhere"),
    }[kind]()
    before = out.lstat().st_ino
    with pytest.raises(FileExistsError):
        rename_to_new(tmp_path / "new", out)
    assert out.lstat().st_ino == before
    assert (tmp_path / "new").is_dir()


def test_a_move_that_fails_leaves_the_name_free(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(atomic_rename, "_rename", lambda *_arguments: False)
    with pytest.raises(FileNotFoundError):
        rename_to_new(tmp_path / "absent", tmp_path / "out")
    assert os.listdir(tmp_path) == []


def test_two_directories_change_places(tmp_path: Path):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    assert exchange(tmp_path / "one", tmp_path / "other")
    assert os.listdir(tmp_path / "one") == ["other"]
    assert os.listdir(tmp_path / "other") == ["one"]


def test_what_the_system_refuses_is_told(tmp_path: Path):
    with pytest.raises(FileNotFoundError) as caught:
        exchange(tmp_path / "absent", tmp_path / "other")
    assert caught.value.errno == errno.ENOENT
    assert caught.value.filename == str(tmp_path / "absent")


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EINVAL])
def test_a_file_system_that_cannot_exchange_says_no(tmp_path: Path, monkeypatch, number: int):
    class Library:
        @staticmethod
        def renameat2(*_arguments: object) -> int:
            atomic_rename.ctypes.set_errno(number)
            return -1

    monkeypatch.setattr(atomic_rename.ctypes, "CDLL", lambda *_arguments, **_options: Library)
    assert not exchange(tmp_path / "one", tmp_path / "other")
