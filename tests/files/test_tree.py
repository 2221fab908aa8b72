"""Directories that are one thing, such as a recording of many files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from vlatool.errors import DataError
from vlatool.files.blob_store import link_or_copy, mark_cache
from vlatool.files.tree import files_below, hash_directory


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "log/deep").mkdir(parents=True)
    for name, content in (("b", "two"), ("deep/a", "one"), (".hidden", ""), (".DS_Store", "litter")):
        (tmp_path / "log" / name).write_text(content)
    (tmp_path / "log/linked").symlink_to("b")
    return tmp_path / "log"


def test_all_files_are_named_in_order_and_links_count_as_files(folder: Path):
    assert list(files_below(folder)) == [".hidden", "b", "deep/a", "linked"]


@pytest.mark.parametrize("change", ["content", "name", "more", "fewer", "swapped"])
def test_a_hash_knows_names_and_contents(folder: Path, change: str):
    before = hash_directory(folder)
    (folder / ".DS_Store").write_text("other")
    assert hash_directory(folder) == before
    match change:
        case "content":
            (folder / "b").write_text("owt")
        case "name":
            (folder / "b").rename(folder / "c")
            (folder / "linked").unlink()
            (folder / "linked").symlink_to("c")
        case "more":
            (folder / "deep/z").touch()
        case "fewer":
            (folder / ".hidden").unlink()
        case _:
            (folder / "b").write_text("one")
            (folder / "deep/a").write_text("two")
    assert hash_directory(folder) != before


@pytest.mark.parametrize("kind", ["pipe", "link to a folder", "broken link"])
def test_what_is_not_a_file_is_refused_by_name(folder: Path, kind: str):
    if kind == "pipe":
        os.mkfifo(folder / "deep/odd")
    else:
        (folder / "deep/odd").symlink_to(folder.parent if kind == "link to a folder" else "nowhere")
    with pytest.raises(DataError, match=r"log holds deep/odd, which is not a file"):
        hash_directory(folder)


def test_a_directory_is_carried_file_by_file_and_large_ones_are_in_the_cache_once(folder: Path, tmp_path: Path):
    (folder / "large").write_bytes(bytes(1 << 20))
    mark_cache(tmp_path / "cache")
    stages = [tmp_path / "cache/stages" / name / "data/calibration" for name in ("a", "b")]
    for target in stages:
        target.parent.mkdir(parents=True)
        link_or_copy(folder, target)
    assert os.path.samefile(*(target / "large" for target in stages))
    assert not (stages[0] / "linked").is_symlink()
    assert hash_directory(stages[0]) == hash_directory(stages[1]) == hash_directory(folder)
