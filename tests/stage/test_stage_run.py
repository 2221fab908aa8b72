"""Stages run into place, and results are kept and used again."""

from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest

from vlatool.benchmark.latency import Latency
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, GraphError, OutputError, RecipeError
from vlatool.evaluate.recorded import Recorded
from vlatool.files.directory_writer import write_directory
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.report import Report
from vlatool.stage.base import Context
from vlatool.stage.run import cache_directory, cached_measure, cached_path, cached_transform, run_transform, work_folder


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every file: both change when a file is written again."""
    return {str(path): (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}


class Listener:
    """A context that remembers what it was told."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.context = Context(lambda what, _share: self.told.append(what))


def test_a_stage_runs_into_place_and_nothing_is_left_beside_it(float_bundle, tmp_path):
    out = tmp_path / "place" / "out"
    made = run_transform(DynamicInt8(), float_bundle, out, Context()).bundle
    assert Bundle.open(out).hash == made.hash
    assert made.manifest.parent == float_bundle.hash
    assert list(out.parent.iterdir()) == [out]


def test_an_output_that_exists_is_kept_without_force_and_replaced_with_it(float_bundle, tmp_path):
    with write_directory(tmp_path / "out") as draft:
        (draft / "old").touch()
    with pytest.raises(OutputError, match="exists already"):
        run_transform(DynamicInt8(), float_bundle, tmp_path / "out", Context())
    assert (tmp_path / "out" / "old").exists()
    run_transform(DynamicInt8(), float_bundle, tmp_path / "out", Context(), force=True)
    assert not (tmp_path / "out" / "old").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("force", [False, True])
def test_a_stage_that_fails_leaves_what_was_there(float_bundle, copied, resealed, tmp_path, force):
    broken = copied(float_bundle)
    (broken.path / "graphs/main.onnx").write_bytes(b"no graph")
    place = tmp_path / "place"
    place.mkdir()
    if force:
        (place / "out").mkdir()
    with pytest.raises(GraphError):
        run_transform(StaticInt8(), resealed(broken), place / "out", Context(), force=force)
    assert [path.name for path in place.iterdir()] == (["out"] if force else [])


def test_a_stage_is_checked_before_anything_is_written(float_bundle, tmp_path):
    with pytest.raises(DataError, match=r"Data file .* not found"):
        run_transform(StaticInt8(calibration=tmp_path / "none.npz"), float_bundle, tmp_path / "a/b/out", Context())
    assert list(tmp_path.iterdir()) == []


def test_a_second_run_reads_the_cache_and_gives_the_same_bundle(float_bundle, tmp_path):
    first = cached_transform(DynamicInt8(), float_bundle, tmp_path, Context()).bundle
    before = stamps(tmp_path)
    second = cached_transform(DynamicInt8(), float_bundle, tmp_path, Context()).bundle
    assert (second.hash, second.path) == (first.hash, first.path)
    assert stamps(tmp_path) == before


def test_other_options_are_another_entry(float_bundle, tmp_path):
    one, other = DynamicInt8(), DynamicInt8(per_channel=False)
    cached_transform(one, float_bundle, tmp_path, Context())
    assert cached_path(one, float_bundle.hash, tmp_path).is_dir()
    assert not cached_path(other, float_bundle.hash, tmp_path).is_dir()
    assert not cached_path(one, "sha256:another", tmp_path).is_dir()
    assert cached_path(one, float_bundle.hash, tmp_path).parent == tmp_path / "stages"


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: (path / "graphs/main.onnx").write_bytes(b"half"),
        lambda path: (path / "graphs/main.onnx").unlink(),
        lambda path: (path / "manifest.json").write_text("{"),
        lambda path: (path / "manifest.json").unlink(),
    ],
    ids=["graph changed", "graph missing", "manifest cut", "manifest missing"],
)
def test_a_damaged_bundle_in_the_cache_is_made_again_and_that_is_said(float_bundle, tmp_path, damage):
    first = cached_transform(DynamicInt8(), float_bundle, tmp_path, Context()).bundle
    damage(first.path)
    listener = Listener()
    assert cached_transform(DynamicInt8(), float_bundle, tmp_path, listener.context).bundle.hash == first.hash
    assert Bundle.open(first.path).hash == first.hash
    assert "the cached quantize.dynamic_int8 is damaged; making it again" in listener.told


def test_a_report_is_kept_read_again_and_measured_afresh_when_asked(float_bundle, tmp_path):
    stage = Latency(iterations=20, duration=0, cold=False, reach=False)
    first = cached_measure(stage, float_bundle, tmp_path, Context())
    before = stamps(tmp_path)
    assert cached_measure(stage, float_bundle, tmp_path, Context()) == first
    assert stamps(tmp_path) == before
    again = cached_measure(stage, float_bundle, tmp_path, Context(), fresh=True)
    assert again.rows[0].raw != first.rows[0].raw
    assert cached_measure(stage, float_bundle, tmp_path, Context()) == again


def test_a_damaged_report_in_the_cache_is_measured_again_and_that_is_said(float_bundle, tmp_path):
    stage = Recorded(samples=2)
    first = cached_measure(stage, float_bundle, tmp_path, Context())
    (cached_path(stage, float_bundle.hash, tmp_path) / "report.json").write_text("{")
    listener = Listener()
    assert cached_measure(stage, float_bundle, tmp_path, listener.context).rows == first.rows
    assert "the cached evaluate.recorded is damaged; measuring again" in listener.told


def test_where_the_cache_is(monkeypatch, tmp_path):
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "own"))
    assert cache_directory() == tmp_path / "own"
    monkeypatch.delenv("VLATOOL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_directory() == tmp_path / "xdg" / "vlatool"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_directory() == tmp_path / "home" / ".cache" / "vlatool"


def test_a_stage_that_needs_a_bundle_says_how_to_begin_before_it_runs(tmp_path):
    with pytest.raises(RecipeError, match=r"quantize.dynamic_int8 needs a bundle to start from"):
        run_transform(DynamicInt8(), None, tmp_path / "out", Context())
    assert list(tmp_path.iterdir()) == []


def test_notes_and_the_folder_of_unfinished_work_come_from_who_writes_the_report(float_bundle, tmp_path, monkeypatch):
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    seen: list[str] = []

    def run(_stage: Recorded, _source: Bundle, context: Context) -> Report:
        Path(context.work).mkdir(parents=True)
        (Path(context.work) / "lock").touch()
        context.note("one worker was slow")
        return Report("evaluate", "title", "info")

    monkeypatch.setattr(Recorded, "run", run)
    cached_measure(Recorded(), float_bundle, tmp_path / "cache", Context(note=seen.append))
    assert seen == ["one worker was slow"]
    assert not work_folder(Recorded(), float_bundle).exists()


def test_a_context_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        Context().workers = 2
    assert not [name for name, value in vars(Context()).items() if isinstance(value, list | dict | set)]
