import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _tiny import observations

from vlatool.bundle.bundle import Bundle
from vlatool.evaluate.recorded import Recorded
from vlatool.files.blob_store import FILES
from vlatool.files.locks import acquire, release
from vlatool.files.resumable_work import work_directory
from vlatool.graph.workload import workload
from vlatool.graph.workload_file import LAYOUT_VERSION, write_workload
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.stage import cache as cache_module
from vlatool.stage.base import Context
from vlatool.stage.cache import contents, prune
from vlatool.stage.run import cached_measure, cached_transform

DAY = 86_400.0
FOREIGN = ("notes.txt", "stages/mine.npz", "stages/quantize.mine-0123456789abcdef/a.txt", "peers/model.onnx", "files/x")


def age(cache: Path, days: float = 1.0) -> None:
    """Let everything have been used days ago; give up the locks of this process."""
    for path in [*cache.rglob("*"), cache]:
        found = path.lstat().st_mtime_ns
        os.utime(path, ns=(found, found - int(days * DAY * 1e9)), follow_symlinks=False)
    for path in (cache / "stages").iterdir():
        release(path)


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def kept(cache: Path, float_bundle: Bundle) -> Bundle:
    """A bundle in the cache, with a report of it and a count, a day old."""
    made = cached_transform(DynamicInt8(), float_bundle, cache, Context()).bundle
    cached_measure(Recorded(samples=2), made, cache, Context())
    (cache / "workloads").mkdir()
    write_workload(cache / "workloads" / f"{'0' * 32}.json", workload(float_bundle))
    age(cache)
    return made


def strangers(cache: Path) -> list[Path]:
    made = [cache / name for name in FOREIGN]
    for path in made:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("mine")
    return made


def test_entries_are_stages_reports_and_counts(kept: Bundle, cache: Path):
    found = contents(cache)
    assert sorted(entry.what for entry in found.entries) == [
        "count of a policy", "evaluate.recorded", "quantize.dynamic_int8"
    ]  # fmt: skip
    assert found.unknown == ()
    files = [path for path in cache.rglob("*") if path.is_file() and path.name != "CACHEDIR.TAG"]
    assert found.bytes == sum(path.stat().st_size for path in files)


def test_a_cache_that_is_not_there_is_empty(tmp_path: Path):
    assert contents(tmp_path / "none").entries == ()
    assert prune(tmp_path / "none", older_than_s=0).freed == 0


def test_what_was_removed_is_made_again(kept: Bundle, cache: Path, float_bundle: Bundle):
    freed = contents(cache).bytes
    removed = prune(cache, older_than_s=0)
    assert len(removed.entries) == 3
    assert (removed.freed, removed.stays, contents(cache).bytes) == (freed, {}, 0)
    assert cached_transform(DynamicInt8(), float_bundle, cache, Context()).bundle.hash == kept.hash


def test_a_dry_run_says_the_same_and_removes_nothing(kept: Bundle, cache: Path):
    before = contents(cache)
    told = prune(cache, older_than_s=0, dry_run=True)
    assert contents(cache) == before
    real = prune(cache, older_than_s=0)
    assert (told.freed, [entry.name for entry in told.entries]) == (real.freed, [entry.name for entry in real.entries])


def test_only_what_is_older_is_removed(kept: Bundle, cache: Path):
    os.utime(kept.path, (0, 0))
    assert [entry.what for entry in prune(cache, older_than_s=2 * DAY).entries] == ["quantize.dynamic_int8"]
    assert prune(cache, older_than_s=2 * DAY).entries == ()
    assert len(contents(cache).entries) == 2


def test_the_least_recently_used_goes_first_until_it_is_small_enough(kept: Bundle, cache: Path):
    os.utime(kept.path, (0, 0))
    everything = contents(cache)
    assert prune(cache, most_bytes=everything.bytes).entries == ()
    removed = prune(cache, most_bytes=everything.bytes - 1)
    assert [entry.what for entry in removed.entries] == ["quantize.dynamic_int8"]


def test_a_stage_that_was_used_is_no_longer_old(kept: Bundle, cache: Path, float_bundle: Bundle):
    cached_transform(DynamicInt8(), float_bundle, cache, Context())
    release(kept.path)
    assert "quantize.dynamic_int8" not in {entry.what for entry in prune(cache, older_than_s=DAY / 2).entries}


def test_what_vlatool_did_not_write_is_named_and_never_removed(kept: Bundle, cache: Path, tmp_path: Path):
    mine = strangers(cache)
    (kept.path / "mine.txt").write_text("mine")
    (cache / "stages" / "quantize.link-0123456789abcdef").symlink_to(kept.path)
    os.utime(kept.path, (0, 0))
    assert contents(cache).unknown == (
        "files/x", "notes.txt", "peers", "stages/mine.npz", "stages/quantize.link-0123456789abcdef",
        "stages/quantize.mine-0123456789abcdef",
    )  # fmt: skip
    removed = prune(cache, older_than_s=0)
    assert removed.stays == {f"stages/{kept.path.name}": "holds what vlatool did not write"}
    assert [path.read_text() for path in [*mine, kept.path / "mine.txt"]] == ["mine"] * 6
    assert list(kept.path.iterdir()) == [kept.path / "mine.txt"]


def test_a_list_that_names_files_elsewhere_removes_none_there(cache: Path, tmp_path: Path):
    victim = tmp_path / "victim.txt"
    victim.write_text("mine")
    folder = cache / "stages" / "quantize.mine-0123456789abcdef"
    (folder / "in").mkdir(parents=True)
    (folder / "in/link.txt").symlink_to(victim)
    from vlatool.files.ownership import LEDGER, Listing, _ledger_bytes

    names = ("../../../victim.txt", str(victim), "in/link.txt")
    (folder / LEDGER).write_bytes(_ledger_bytes(Listing.of(dict.fromkeys(names, "0" * 64))))
    age(cache)
    prune(cache, older_than_s=0)
    assert victim.read_text() == "mine"
    assert (folder / "in/link.txt").is_symlink()


def test_what_this_process_uses_stays(kept: Bundle, cache: Path, float_bundle: Bundle):
    cached_transform(DynamicInt8(), float_bundle, cache, Context())
    os.utime(kept.path, (0, 0))
    removed = prune(cache, older_than_s=0)
    assert removed.stays == {f"stages/{kept.path.name}": "is in use by a running process"}
    Bundle.open(kept.path)


HOLD = """
import sys
from pathlib import Path
from vlatool.files.locks import acquire
print(acquire(Path(sys.argv[1])), flush=True)
sys.stdin.read()
"""


def test_what_another_process_uses_stays_until_it_ends(kept: Bundle, cache: Path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, kept.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "True\n"
        os.utime(kept.path, (0, 0))
        assert len(prune(cache, older_than_s=0).entries) == 2
        Bundle.open(kept.path)
        other.communicate()
    assert [entry.what for entry in prune(cache, older_than_s=0).entries] == ["quantize.dynamic_int8"]


def test_what_was_just_made_stays(kept: Bundle, cache: Path):
    os.utime(kept.path)
    assert prune(cache, older_than_s=0).stays[f"stages/{kept.path.name}"] == "was made or used in the last 60 s"


def test_what_took_long_to_flush_was_just_made(cache: Path, float_bundle: Bundle, monkeypatch: pytest.MonkeyPatch):
    """Its folder is as old as the last file in it, but nobody has had the time to lock it."""
    monkeypatch.setattr("vlatool.files.directory_writer._flush", lambda folder: os.utime(folder, (0, 0)))
    monkeypatch.setattr("vlatool.stage.run.acquire", lambda path: False)
    made = cached_transform(DynamicInt8(), float_bundle, cache, Context()).bundle
    assert prune(cache, older_than_s=DAY).entries == ()
    assert Bundle.open(made.path)


def test_an_entry_that_is_gone_cannot_be_held(kept: Bundle, cache: Path):
    prune(cache, older_than_s=0)
    assert not acquire(kept.path)


def test_a_shared_recording_goes_with_the_last_stage_that_holds_it(cache: Path, float_bundle: Bundle, copied: Any):
    from vlatool.bundle.bundle import seal

    bundle = copied(float_bundle)
    np.savez(bundle.path / "data/calibration.npz", **observations(6000, seed=1))
    bundle = seal(bundle.path, bundle.manifest)
    stages = [DynamicInt8(), DynamicInt8(exclude=["head*"])]
    paths = [cached_transform(stage, bundle, cache, Context()).bundle.path for stage in stages]
    age(cache)
    assert contents(cache).sizes(contents(cache).entries[0])[1] > 1 << 20
    os.utime(paths[0], (0, 0))
    assert prune(cache, older_than_s=2 * DAY).freed < 1 << 20
    assert len(list((cache / FILES).iterdir())) == 1
    assert prune(cache, older_than_s=0).freed > 1 << 20
    assert list((cache / FILES).iterdir()) == []


def test_drafts_of_killed_writers_are_removed_and_those_of_living_ones_stay(kept: Bundle, cache: Path):
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    (cache / FILES).mkdir()
    dead = cache / FILES / f".{'a' * 64}.{int(gone.stdout)}-0123abcd.part"
    living = cache / FILES / f".{'a' * 64}.{os.getpid()}-0123abcd.part"
    elsewhere = cache / FILES / f".{'a' * 64}.{int(gone.stdout)}-4567abcd.part"
    for path in (dead, living, elsewhere):
        path.write_text("half")
    long_ago = time.time_ns() / 1e9 - DAY
    for path in (dead, living):
        os.utime(path, (long_ago, long_ago))
    prune(cache, older_than_s=1000 * DAY)
    assert [path.exists() for path in (dead, living, elsewhere)] == [False, True, True]
    assert contents(cache).unknown == ()


def test_drafts_of_counts_are_vlatools_and_go_when_their_writers_are_gone(kept: Bundle, cache: Path, tmp_path: Path):
    names = [f".{'a' * 32}.json.vlatool-{process}-01234567.part" for process in (2**22 + 1, os.getpid())]
    mine = f".notes.vlatool-{2**22 + 1}-01234567.part"
    for name in (*names, mine):
        (cache / "workloads" / name).write_text("half")
    assert contents(cache).unknown == (f"workloads/{mine}",)
    prune(cache, older_than_s=1000 * DAY)
    assert [(cache / "workloads" / name).exists() for name in (*names, mine)] == [False, True, True]


def test_nothing_is_removed_behind_a_link(kept: Bundle, cache: Path, tmp_path: Path):
    (cache / "workloads").rename(tmp_path / "elsewhere")
    (cache / "workloads").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / f".{'a' * 32}.json.vlatool-{2**22 + 1}-01234567.part").write_text("half")
    before = sorted((tmp_path / "elsewhere").iterdir())
    prune(cache, older_than_s=0)
    assert sorted((tmp_path / "elsewhere").iterdir()) == before


def test_what_another_process_removes_meanwhile_is_no_entry(kept: Bundle, cache: Path, monkeypatch: pytest.MonkeyPatch):
    (cache / FILES).mkdir()
    gone = {folder: cache / folder / name for folder, name in (
        ("stages", "export.onnx-" + "0" * 16), ("workloads", "0" * 32 + ".json"), (FILES, "c" * 64))}  # fmt: skip
    below = cache_module._children
    monkeypatch.setattr(
        cache_module,
        "_children",
        lambda folder: below(folder) + [gone[name] for name in gone if name == folder.name],
    )
    before = {path.relative_to(cache).as_posix() for path in below(cache / "stages")}
    found = contents(cache)
    assert {entry.name for entry in found.entries if entry.name.startswith("stages")} == before
    assert (found.kept, found.unknown) == ({}, ())


def test_a_file_that_only_looks_like_a_shared_one_stays(kept: Bundle, cache: Path):
    (cache / FILES).mkdir()
    (cache / FILES / ("b" * 64)).write_text("mine")
    removed = prune(cache, older_than_s=0)
    assert removed.stays == {f"files/{'b' * 64}": "is not what its name says"}
    assert (cache / FILES / ("b" * 64)).read_text() == "mine"


@pytest.mark.parametrize(
    "name", ["trials.db", "trials.db-journal", "expert/round-000/action.npy", "held-out/expert/draft-000/image.npy",
             *(f".{name}.vlatool-{2**22 + 1}-01234567.part" for name in (
                 "round-000.json", "checkpoint.safetensors", f"answer-{'a' * 32}.json"))]
)  # fmt: skip
def test_trials_and_what_an_expert_did_are_unfinished_work(cache: Path, name: str):
    place = cache / "streams" / "optimize.trials-0123456789abcdef"
    with work_directory(place):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(b"some")
    (cache / "stages").mkdir()
    assert not contents(cache).unknown
    age(cache)
    prune(cache, older_than_s=3600)
    assert not (place / name).exists()


def test_unfinished_work_is_an_entry_that_its_lock_protects(cache: Path):
    place = cache / "streams" / "abc"
    with work_directory(place):
        for name in ("data", "checkpoint.safetensors", "round-000/image.npy", "draft-001/episodes/00001/image.npy"):
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(b"half")
        (cache / "stages").mkdir()
        age(cache)
        assert prune(cache, older_than_s=0).stays == {"streams/abc": "is in use by a running process"}
    age(cache)
    assert [entry.what for entry in prune(cache, older_than_s=0).entries] == ["unfinished work"]
    assert not place.exists()


@pytest.mark.parametrize(("change", "ours"), [(("", ""), True), (('"layout": LAYOUT', '"layout": 3'), True),
                                              (("graphs", "others"), False), (("{", "["), False)])  # fmt: skip
def test_a_count_of_an_earlier_layout_is_vlatools_too(cache, float_bundle, change, ours) -> None:
    file = cache / "workloads" / f"{'1' * 32}.json"
    write_workload(file, workload(float_bundle))
    old, new = (part.replace("LAYOUT", str(LAYOUT_VERSION)) for part in change)
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new) if old else file.read_text())
    held = contents(cache)
    assert (f"workloads/{file.name}" in {entry.name for entry in held.entries}) is ours
    assert (f"workloads/{file.name}" in held.unknown) is not ours
