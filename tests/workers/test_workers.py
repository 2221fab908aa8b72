"""What ``--workers`` takes, and what reaches another machine."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from vlatool.errors import OutputError, SourceError, UsageError
from vlatool.workers import Folder, Work, launcher, parse_workers
from vlatool.workers._file_transfer import IncomingParcel, PathTranslation, blocks, parcel_of


@pytest.mark.parametrize(("text", "asked"), [
    ("4", ("processes", 4)), ("ray", ("ray", 0)), ("ray:8", ("ray", 8)), ("processes:2", ("processes", 2)),
])  # fmt: skip
def test_workers_are_a_number_or_a_launcher(text: str, asked: tuple[str, int]):
    assert parse_workers(text) == asked


@pytest.mark.parametrize(("text", "says"), [
    ("rya", "did you mean 'ray'"), ("", "a number of processes"), ("0", "1 or more"), ("-2", "a number of processes"),
    ("ray:0", "1 or more"), ("ray:", "1 or more"), ("ray:x", "1 or more"), ("2.5", "a number of processes"),
])  # fmt: skip
def test_what_is_neither_is_told(text: str, says: str):
    with pytest.raises(UsageError, match=says):
        parse_workers(text)


def test_answers_are_in_order_and_are_told_as_they_come():
    work = Work("vlatool.episodes.play:close", [{}, {}, {}], "nothing")
    done: list[int] = []
    answers = launcher("processes", 2).answers(work, lambda *_: None, lambda at, _: done.append(at), done.append)
    assert list(answers) == [None] * 3
    assert sorted(done) == [0, 1, 2]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with code, data in a folder below, an empty file, a program and what is not sent."""
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    made = tmp_path / "world"
    for name, content in {"a.py": b"x = 1\n", "meshes/b.bin": os.urandom(3 << 20), "empty": b"", "run": b"#!/bin/sh\n",
                          ".git/config": b"mine", "__pycache__/a.pyc": b"old"}.items():  # fmt: skip
        (made / name).parent.mkdir(parents=True, exist_ok=True)
        (made / name).write_bytes(content)
    (made / "run").chmod(0o755)
    (made / "linked.py").symlink_to(made / "a.py")
    return made


def arrived(parcel, size: int = 1 << 20) -> Path:
    arriving = IncomingParcel(parcel)
    for block in blocks(parcel):
        for at in range(0, len(block), size):
            arriving.add(block[at : at + size])
    arriving.end()
    return parcel.place


def test_a_folder_arrives_whole_and_is_known_by_its_content(folder: Path):
    parcel = parcel_of(Folder(str(folder)))
    assert not parcel.is_here()
    place = arrived(parcel)
    assert parcel.is_here()
    names = ["a.py", "empty", "linked.py", "meshes/b.bin", "run"]
    assert sorted(file.name for file in parcel.files) == names
    assert [(place / name).read_bytes() for name in names] == [(folder / name).read_bytes() for name in names]
    assert os.access(place / "run", os.X_OK)
    assert not (place / "linked.py").is_symlink()
    (folder / "a.py").write_text("x = 2\n")
    assert parcel_of(Folder(str(folder))).digest != parcel.digest


def test_what_was_damaged_there_is_sent_again(folder: Path):
    parcel = parcel_of(Folder(str(folder)))
    place = arrived(parcel)
    (place / "a.py").write_text("x = 3\n")
    assert not parcel.is_here()
    arrived(parcel, 1 << 16)
    assert (place / "a.py").read_text() == "x = 1\n"


def test_half_of_it_is_nothing(folder: Path):
    parcel = parcel_of(Folder(str(folder)))
    arriving = IncomingParcel(parcel)
    arriving.add(next(blocks(parcel))[: 1 << 20])
    with pytest.raises((OutputError, OSError)) as caught:
        arriving.end()
    arriving.abandon(caught.value)
    assert not parcel.is_here()


def test_too_much_is_refused_by_the_name_of_its_limit(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "shipped_bytes=1e6")
    with pytest.raises(SourceError, match="the limit 'shipped_bytes' allows 1000000") as caught:
        parcel_of(Folder(str(folder)))
    assert "VLATOOL_LIMITS=shipped_bytes" in caught.value.fix


def test_paths_are_those_of_the_other_side():
    places = PathTranslation([("/a", "/cache/1"), ("/a/out/b", "/cache/2")])
    asked = {"bundle": "/a/out/b", "file": "/a/e.py:make", "other": "/ab", "seeds": [1, 2], "text": "see /a/e.py"}
    assert places.translate(asked) == {**asked, "bundle": "/cache/2", "file": "/cache/1/e.py:make"}
    back = PathTranslation([("/cache/1", "/a"), ("/cache/2", "/a/out/b")])
    assert back.rewrite({"message": "/cache/1/e.py failed, not /cache/2"}) == {
        "message": "/a/e.py failed, not /a/out/b"
    }
