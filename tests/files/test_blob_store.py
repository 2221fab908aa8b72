import errno
import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from _tiny import observations

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.errors import BundleError
from vlatool.export.onnx import ExportOnnx
from vlatool.files import blob_store
from vlatool.files.blob_store import FILES, TAG, cache_containing, is_cache, link_or_copy, mark_cache
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.weight_only import WeightOnly
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.finish import carry_over
from vlatool.stage.run import cached_path, cached_transform, run_transform


@pytest.fixture(autouse=True)
def _small_files_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blob_store, "MIN_SHARED_BYTES", 4000)


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    place = tmp_path / "cache"
    mark_cache(place)
    (place / "stages").mkdir()
    return place


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "recording.npz"
    path.write_bytes(np.random.default_rng(0).bytes(5000))
    return path


def in_stage(cache: Path, name: str) -> Path:
    folder = cache / "stages" / name
    folder.mkdir(exist_ok=True)
    return folder / "recording.npz"


def used(folder: Path) -> int:
    """Bytes on the disk, each inode once."""
    found = {path.stat().st_ino: path.stat().st_size for path in folder.rglob("*") if path.is_file()}
    return sum(found.values())


def test_a_recording_is_in_the_cache_once(cache: Path, recording: Path):
    first, second = in_stage(cache, "one"), in_stage(cache, "two")
    link_or_copy(recording, first)
    link_or_copy(first, second, hash_file(first))
    assert first.stat().st_ino == second.stat().st_ino != recording.stat().st_ino
    assert second.read_bytes() == recording.read_bytes()
    assert [path.name for path in (cache / FILES).iterdir()] == [hash_file(recording)]


def test_a_source_that_changed_its_code_alone_links_the_same_recording(cache: Path, recording: Path):
    for name in ("one", "two"):
        link_or_copy(recording, in_stage(cache, name))
    assert used(cache) < 2 * recording.stat().st_size


def test_shared_files_are_read_only_and_the_persons_file_stays_writable(cache: Path, recording: Path):
    before = recording.stat().st_mode
    link_or_copy(recording, in_stage(cache, "one"))
    assert stat.S_IMODE(in_stage(cache, "one").stat().st_mode) == 0o444
    assert recording.stat().st_mode == before


def test_outside_of_the_cache_every_file_is_a_copy_that_may_be_edited(cache: Path, recording: Path, tmp_path: Path):
    link_or_copy(recording, in_stage(cache, "one"))
    link_or_copy(in_stage(cache, "one"), tmp_path / "mine.npz")
    with (tmp_path / "mine.npz").open("r+b") as mine:
        mine.write(b"edited")
    assert in_stage(cache, "one").read_bytes() == recording.read_bytes()


def test_a_folder_of_that_name_without_the_mark_is_no_cache(tmp_path: Path, recording: Path):
    (tmp_path / "stages").mkdir()
    link_or_copy(recording, in_stage(tmp_path, "one"))
    link_or_copy(recording, in_stage(tmp_path, "two"))
    assert in_stage(tmp_path, "one").stat().st_nlink == 1
    (tmp_path / TAG).write_text("Signature: 8a477f597d28d172789f06886806bc55\n# somebody else's\n")
    assert not is_cache(tmp_path)
    assert cache_containing(in_stage(tmp_path, "one")) is None


@pytest.mark.parametrize("number", [errno.EXDEV, errno.EPERM, errno.EMLINK])
def test_without_hard_links_it_is_copied(cache: Path, recording: Path, monkeypatch: pytest.MonkeyPatch, number: int):
    def refused(_source: Path, _target: Path) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(blob_store.os, "link", refused)
    link_or_copy(recording, in_stage(cache, "one"))
    assert in_stage(cache, "one").read_bytes() == recording.read_bytes()


def test_a_full_disk_is_no_reason_to_copy(cache: Path, recording: Path, monkeypatch: pytest.MonkeyPatch):
    def full(_source: Path, _target: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(blob_store.os, "link", full)
    with pytest.raises(OSError, match="No space"):
        link_or_copy(recording, in_stage(cache, "one"))
    assert not in_stage(cache, "one").exists()


def test_a_kept_file_that_was_damaged_is_not_linked_again(cache: Path, recording: Path):
    link_or_copy(recording, in_stage(cache, "one"))
    kept = cache / FILES / hash_file(recording)
    kept.chmod(0o644)
    kept.write_bytes(b"x" * 5000)
    link_or_copy(recording, in_stage(cache, "two"))
    assert in_stage(cache, "two").read_bytes() == recording.read_bytes()
    assert hash_file(kept) == kept.name


def test_a_hash_that_is_a_path_leads_nowhere(cache: Path, recording: Path):
    link_or_copy(recording, in_stage(cache, "one"), "../../../stolen")
    assert in_stage(cache, "one").read_bytes() == recording.read_bytes()
    assert not (cache / FILES).exists()


def test_what_a_removed_kept_file_leaves_is_made_again(cache: Path, recording: Path, monkeypatch: pytest.MonkeyPatch):
    real, times = os.link, []

    def removed_before(source: Path, target: Path) -> None:
        times.append(source)
        if len(times) == 1:
            Path(source).unlink()
        real(source, target)

    monkeypatch.setattr(blob_store.os, "link", removed_before)
    link_or_copy(recording, in_stage(cache, "one"))
    assert len(times) == 2
    assert in_stage(cache, "one").stat().st_nlink == 2


def test_many_threads_keep_one_file(cache: Path, recording: Path):
    threads = [
        threading.Thread(target=link_or_copy, args=(recording, in_stage(cache, f"s{each}"))) for each in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [path.name for path in (cache / FILES).iterdir()] == [hash_file(recording)]
    assert all(in_stage(cache, f"s{each}").read_bytes() == recording.read_bytes() for each in range(8))


@pytest.fixture
def recorded_policy(policy_dir: Path) -> Path:
    """A tiny policy whose calibration recording is large enough to be shared by child processes, too."""
    np.savez(policy_dir / "calibration.npz", **observations(6000, seed=1))
    assert (policy_dir / "calibration.npz").stat().st_size > 1 << 20
    return policy_dir


def chain(policy: Path, cache: Path) -> list[Bundle]:
    source = cached_transform(TorchModule(policy=policy), None, cache, Context()).bundle
    exported = cached_transform(ExportOnnx(samples=2), source, cache, Context()).bundle
    return [source, exported, cached_transform(DynamicInt8(), exported, cache, Context()).bundle]


def test_the_stages_of_a_policy_share_its_recordings(recorded_policy: Path, cache: Path):
    made = chain(recorded_policy, cache)
    assert len({bundle.file("data/calibration.npz").stat().st_ino for bundle in made}) == 1
    for bundle in made:
        Bundle.open(bundle.path)


def test_a_recording_that_was_edited_in_the_cache_is_noticed_in_every_stage_and_made_again(
    recorded_policy: Path, cache: Path
):
    made = chain(recorded_policy, cache)
    recording = made[-1].file("data/calibration.npz")
    recording.chmod(0o644)
    with recording.open("r+b") as stream:
        stream.seek(1000)
        stream.write(b"edited")
    for bundle in made:
        with pytest.raises(BundleError, match="has changed"):
            Bundle.open(bundle.path)
    mended = chain(recorded_policy, cache)
    assert [bundle.hash for bundle in mended] == [bundle.hash for bundle in made]
    for bundle in mended:
        Bundle.open(bundle.path)
    assert len({bundle.file("data/calibration.npz").stat().st_ino for bundle in mended}) == 1


def test_an_output_that_a_person_edits_leaves_the_cache_as_it_is(recorded_policy: Path, cache: Path, tmp_path: Path):
    _, exported, _ = chain(recorded_policy, cache)
    out = run_transform(DynamicInt8(), exported, tmp_path / "out", Context()).bundle
    assert out.file("data/calibration.npz").stat().st_nlink == 1
    with out.file("data/calibration.npz").open("r+b") as stream:
        stream.write(b"edited")
    Bundle.open(exported.path)
    with pytest.raises(BundleError, match="has changed"):
        Bundle.open(out.path)


def test_folders_that_are_carried_over_need_no_manifest_entry(float_bundle: Bundle, cache: Path):
    target = cached_path(WeightOnly(), float_bundle.hash, cache)
    carry_over(Bundle(float_bundle.path, float_bundle.manifest), target)
    assert (target / "data/calibration.npz").read_bytes() == (float_bundle.path / "data/calibration.npz").read_bytes()


def test_the_tag_is_what_backups_look_for(cache: Path, copied: Callable[[Bundle], Bundle], float_bundle: Bundle):
    assert (cache / TAG).read_bytes()[:43] == b"Signature: 8a477f597d28d172789f06886806bc55"
    assert is_cache(cache)
    assert not is_cache(copied(float_bundle).path)
