"""Which recording of a bundle, and which half of it, serves which purpose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import (
    NamedRecording,
    calibration_recording,
    carries_evaluation,
    carry_recording,
    evaluation_recording,
    is_of_recording,
    read_recording,
    recordings_of,
)
from vlatool.errors import DataError

SPEC = PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 1)),), 10.0)


def recorded(path: Path, count: int, name: str = "x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        np.savez(stream, **{name: np.arange(2 * count, dtype=np.float32).reshape(count, 2)})
    return path


def bundle(folder: Path, **counts: int) -> Bundle:
    """A bundle that carries recordings of so many observations."""
    for purpose, count in counts.items():
        carry_recording(recorded(folder.parent / f"{purpose}.npz", count), purpose, SPEC, folder)
    return seal(folder, Manifest("a", "1", SPEC))


@pytest.mark.parametrize(
    ("counts", "calibrates", "evaluates"),
    [
        ({}, None, None), ({"calibration": 32}, 16, 16), ({"calibration": 10}, 10, 10), ({"evaluation": 9}, None, 9),
        ({"calibration": 32, "evaluation": 9}, 32, 9),
    ],
)  # fmt: skip
def test_each_purpose_has_its_own_or_a_half(tmp_path: Path, counts, calibrates, evaluates):
    (tmp_path / "bundle").mkdir()
    made = bundle(tmp_path / "bundle", **counts)
    calibration = calibration_recording(made)
    assert (calibration and len(calibration)) == calibrates
    assert carries_evaluation(made) is (evaluates is not None)
    if evaluates is None:
        with pytest.raises(DataError, match="carries no evaluation data"):
            evaluation_recording(made)
    else:
        held_out, reservation = evaluation_recording(made)
        assert len(held_out) == evaluates
        assert ("there is no evaluation recording" in reservation) is ("evaluation" not in counts)
    named = recorded(tmp_path / "other.npz", 20)
    assert len(evaluation_recording(made, named)[0]) == 20
    assert len(calibration_recording(made, named) or ()) == 20


def test_halves_are_apart(tmp_path: Path):
    (tmp_path / "bundle").mkdir()
    made = bundle(tmp_path / "bundle", calibration=32)
    calibrates, evaluates = calibration_recording(made), evaluation_recording(made)[0]
    assert calibrates is not None
    assert sorted([*calibrates.indices, *evaluates.indices]) == list(range(32))


def test_two_recordings_for_one_purpose_are_refused(tmp_path: Path):
    for name in ("calibration.npz", "calibration.log/a"):
        recorded(tmp_path / "bundle/data" / name, 9)
    with pytest.raises(DataError, match="carries two recordings for calibration: "):
        recordings_of(bundle(tmp_path / "bundle"))


@pytest.mark.parametrize(
    ("name", "is_one"),
    [
        ("data/calibration.npz", True), ("data/evaluation", True), ("data/evaluation/a/b.bin", True),
        ("data/calibration.zarr/0.0", True), ("data/played.npz", False), ("data/calibrations.npz", False),
        ("graphs/calibration.npz", False), ("calibration.npz", False),
    ],
)  # fmt: skip
def test_files_of_recordings_are_known_by_their_names(name: str, is_one: bool):
    assert is_of_recording(name) is is_one


def test_an_archive_of_any_name_is_read_and_carried_as_npz(tmp_path: Path):
    path = recorded(tmp_path / "walks.2024", 9)
    assert len(read_recording(path, SPEC)) == 9
    (tmp_path / "out").mkdir()
    carry_recording(path, "calibration", SPEC, tmp_path / "out")
    assert (tmp_path / "out/data/calibration.npz").read_bytes() == path.read_bytes()


def test_names_of_the_recording_may_differ_from_those_of_the_spec(tmp_path: Path):
    path = recorded(tmp_path / "a.npz", 9, "observation.x")
    assert read_recording(path, SPEC, {"x": "observation.x"}).inputs["x"].shape == (9, 2)
    with pytest.raises(DataError, match="has no 'x'"):
        read_recording(path, SPEC)


def test_of_a_dataset_a_bundle_carries_a_sample_under_the_names_of_the_spec(tmp_path: Path):
    h5py = pytest.importorskip("h5py", reason="HDF5 is read with h5py (extra data)")
    with h5py.File(tmp_path / "demos.hdf5", "w") as file:
        for number in range(20):
            file[f"data/demo_{number}/obs/joints"] = np.full((100, 2), number, np.float32)
            file[f"data/demo_{number}/actions"] = np.zeros((100, 1), np.float32)
    out = tmp_path / "out"
    out.mkdir()
    named = NamedRecording(tmp_path / "demos.hdf5", {"x": "obs/joints"})
    carry_recording(named, "calibration", SPEC, out)
    assert [file.name for file in (out / "data").iterdir()] == ["calibration.npz"]
    recording = read_recording(out / "data/calibration.npz", SPEC)
    assert len(recording) == 512
    assert np.unique(recording.inputs["x"][:, 0], return_counts=True)[1].min() >= 25, "of each episode as many"
    carry_recording(named, "evaluation", SPEC, out, keeps=True)
    recording = read_recording(out / "data/evaluation.npz", SPEC)
    assert np.unique(recording.episodes, return_counts=True)[1].tolist() == [100] * 5


def test_a_recording_with_other_names_is_carried_under_those_of_the_spec(tmp_path: Path):
    path = recorded(tmp_path / "a.npz", 9, "observation.x")
    (tmp_path / "out").mkdir()
    carry_recording(NamedRecording(path, {"x": "observation.x"}), "calibration", SPEC, tmp_path / "out")
    assert len(read_recording(tmp_path / "out/data/calibration.npz", SPEC)) == 9
