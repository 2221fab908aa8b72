from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from vlatool.cli.cache import _human
from vlatool.files.locks import release
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.stage.base import Context
from vlatool.stage.run import cached_transform


@pytest.fixture
def cache(tmp_path: Path, float_bundle) -> Path:
    """A cache with one stage, which was used ten days ago."""
    made = cached_transform(DynamicInt8(), float_bundle, tmp_path / "cache", Context()).bundle
    release(made.path)
    then = made.path.stat().st_mtime - 10 * 86_400
    os.utime(made.path, (then, then))
    return tmp_path / "cache"


def test_size_and_list_tell_what_is_kept(vlatool, cache) -> None:
    (cache / "notes.txt").write_text("mine")
    (cache / "two\nlines").write_text("mine")
    code, out, _ = vlatool("cache", "size", "--cache", cache)
    assert code == 0
    assert "quantize.dynamic_int8            1 kept" in out
    assert "not vlatool's, never removed: notes.txt, two\\nlines\n" in out
    code, out, _ = vlatool("cache", "list", "--cache", cache)
    assert code == 0
    assert "10 d" in out
    assert "stages/quantize.dynamic_int8-" in out


def test_prune_says_what_was_freed_and_what_is_kept(vlatool, cache) -> None:
    assert vlatool("cache", "prune", "--max-size", "1TB", "--cache", cache)[1].startswith(f"{cache}: freed 0 B, ")
    told = vlatool("cache", "prune", "--all", "--dry-run", "--cache", cache)[1].splitlines()[-1]
    assert re.fullmatch(rf"{cache}: would free [\d.]+ kB, 0 B kept", told)


@pytest.mark.parametrize("command", [("prune", "--all"), ("size",), ("list",)])
def test_what_is_no_cache_is_told(vlatool, tmp_path, command) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    code, out, err = vlatool("cache", *command, "--cache", tmp_path)
    assert (code, out) == (3, "")
    assert f"{tmp_path} is not a cache" in err


def test_json_of_size_list_and_prune(vlatool, cache) -> None:
    size = json.loads(vlatool("cache", "size", "--cache", cache, "--json")[1])
    listed = json.loads(vlatool("cache", "list", "--cache", cache, "--json")[1])
    assert size["stages"] == [{"stage": "quantize.dynamic_int8", "entries": 1, "bytes": size["bytes"]}]
    assert listed["entries"][0]["bytes"] == listed["bytes"] == size["bytes"] > 0
    told = json.loads(vlatool("cache", "prune", "--all", "--dry-run", "--cache", cache, "--json")[1])
    done = json.loads(vlatool("cache", "prune", "--all", "--cache", cache, "--json")[1])
    assert told == done | {"dry_run": True}
    assert (done["removed"], done["freed_bytes"], done["bytes"]) == ([listed["entries"][0]["name"]], size["bytes"], 0)


@pytest.mark.parametrize(
    ("asked", "removed"),
    [(["--older-than", "9d"], 1), (["--older-than", "2 w"], 0), (["--max-size", "0B"], 1), (["--max-size", "1GB"], 0)],
)
def test_prune_removes_what_was_asked_for(vlatool, cache, asked, removed) -> None:
    code, out, _ = vlatool("cache", "prune", *asked, "--cache", cache)
    assert code == 0
    assert out.count("removed stages/quantize.dynamic_int8-") == removed


@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        ([], 2, "Nothing is chosen for removal"),
        (["--all", "--max-size", "1GB"], 2, "Nothing is chosen for removal"),
        (["--older-than", "30"], 2, "--older-than is '30'; it must be a number and a unit, such as 30d"),
        (["--older-than", "-3d"], 2, "it must be a number and a unit"),
        (["--older-than", "3y"], 2, "--older-than is '3y'"),
        (["--max-size", "5 apples"], 2, "--max-size is '5 apples'"),
        (["--max-size", "nan"], 2, "--max-size is 'nan'"),
        (["--all", "--cache", "/no/such/place"], 3, "No such directory: /no/such/place"),
    ],
)
def test_wrong_values_are_told(vlatool, cache, line, code, says) -> None:
    line = line if "--cache" in line else [*line, "--cache", cache]
    left, out, err = vlatool("cache", "prune", *line)
    assert (left, out) == (code, "")
    assert says in err
    assert list((cache / "stages").iterdir())


def test_a_cache_that_is_not_there_yet_is_empty(vlatool, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "none"))
    code, out, _ = vlatool("cache", "size")
    assert code == 0
    assert "0 B in 0 entries" in out


def test_sizes_are_readable() -> None:
    told = [_human(size) for size in (0, 999, 1000, 2_800_000_000, 5e12)]
    assert told == ["0 B", "999 B", "1.0 kB", "2.8 GB", "5.0 TB"]
