"""``vlatool data``: what it shows of a dataset, and the samples that it takes of one."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests import _datasets as datasets
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.cli import main
from vlatool.data import read_recording

pytest.importorskip("h5py", reason="datasets of HDF5 are read with h5py (extra data)")
SPEC = PolicySpec(
    (TensorSpec("cam_high", (1, datasets.HEIGHT, datasets.WIDTH, 3), "uint8"), TensorSpec("state", (1, 3))),
    (TensorSpec("action", (1, 1, 2)),),
    10.0,
)


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in words])
    return int(caught.value.code or 0)


def test_a_dataset_is_shown_as_lines_as_json_and_as_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = datasets.aloha(tmp_path / "data")
    assert run("data", "inspect", folder, "-o", tmp_path / "page.html") == 0
    lines = capsys.readouterr().out
    assert "3, 19 steps: 4 to 9 steps each" in lines
    assert "observations/images/cam_high: uint8 48x64x3" in lines
    page = (tmp_path / "page.html").read_text()
    assert page.count("<img ") == 16, "eight of each camera"
    assert page.count("data:image/jpeg;base64,") == 16
    assert run("data", "inspect", folder, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["format"], found["episodes"], found["steps"], found["action"]) == ("hdf5", 3, 19, "action")
    assert run("data", "inspect", folder, "-o", tmp_path / "page.html") == 3
    assert run("data", "inspect", folder, "-o", tmp_path / "page.html", "--force") == 0
    assert run("data", "inspect", folder, "-o", folder / "page.html") == 3
    assert not (folder / "page.html").exists()


def test_samples_are_npz_that_every_command_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, out = datasets.aloha(tmp_path / "data", compress=True), tmp_path / "some.npz"
    assert run("data", "sample", folder, "-o", out, "--samples", 5, "--map", "state=observations/qpos",
               "--map", "cam_high=observations/images/cam_high") == 0  # fmt: skip
    assert "5 samples of" in capsys.readouterr().out
    recording = read_recording(out, SPEC)
    assert (len(recording), len(np.unique(recording.episodes))) == (5, 3)
    for row in range(5):
        step = int(recording.inputs["state"][row][0])
        assert datasets.row_of(recording.observation(row)["cam_high"]) == step
        np.testing.assert_array_equal(recording.actions[row, 0], datasets.ACTION[step])
    assert run("data", "sample", folder, "-o", out) == 3
    assert run("data", "sample", folder, "-o", out, "--force", "--samples", 999) == 0
    with np.load(out) as arrays:
        assert len(arrays["episode"]) == datasets.COUNT


def test_a_file_of_somebody_else_is_not_replaced_and_the_recording_not_written(tmp_path: Path):
    folder = datasets.aloha(tmp_path / "data")
    np.savez(tmp_path / "mine.npz", a=np.zeros(3))
    before = (tmp_path / "mine.npz").read_bytes()
    assert run("data", "sample", folder, "-o", tmp_path / "mine.npz", "--force") == 3
    assert (tmp_path / "mine.npz").read_bytes() == before
    assert run("data", "sample", folder, "-o", folder / "x.npz") == 3
    assert run("data", "sample", folder, "-o", tmp_path / "x.txt") == 2
    assert run("data", "sample", folder, "-o", tmp_path / "x.npz", "--map", "state") == 2
    assert run("data", "sample", folder, "-o", tmp_path / "x.npz", "--map", "state=qpos") == 3
    assert run("data", "inspect", tmp_path / "absent") == 3
    assert not (tmp_path / "x.npz").exists()


def test_samples_for_a_policy_have_its_names_and_chunks(tmp_path: Path, float_bundle):
    spec = float_bundle.manifest.spec
    random, arrays = np.random.default_rng(0), {}
    for tensor in spec.inputs:
        shape = (30, *tensor.shape[1:])
        arrays[f"rec.{tensor.name}"] = (
            np.array(["go"] * 30) if tensor.kind == "text"
            else random.integers(0, 255, shape, np.uint8) if tensor.dtype == "uint8"
            else random.normal(size=shape).astype(tensor.dtype)
        )  # fmt: skip
    np.savez(tmp_path / "all.npz", **arrays)
    pairs = [word for tensor in spec.inputs for word in ("--map", f"{tensor.name}=rec.{tensor.name}")]
    line = ("data", "sample", tmp_path / "all.npz", "-o", tmp_path / "some.npz", "--samples", 4)
    assert run(*line, "--policy", float_bundle.path, *pairs) == 0
    assert len(read_recording(tmp_path / "some.npz", spec)) == 4


@pytest.fixture
def renamed(tmp_path: Path, float_bundle) -> tuple[Path, list[str]]:
    """The bundle's own recording under other names, and the options that say so."""
    inputs = [tensor.name for tensor in float_bundle.manifest.spec.inputs]
    with np.load(float_bundle.path / "data/calibration.npz") as arrays:
        np.savez(tmp_path / "other.npz", **{f"rec.{name}" if name in inputs else name: arrays[name] for name in arrays})
    return tmp_path / "other.npz", [word for name in inputs for word in ("--map", f"{name}=rec.{name}")]


def test_quantize_and_evaluate_take_a_recording_with_other_names(tmp_path: Path, float_bundle, renamed):
    path, pairs = renamed
    line = ("quantize", "static-int8", float_bundle.path, "-o", tmp_path / "int8", "--calibration", path)
    assert run(*line) == 3
    assert not (tmp_path / "int8").exists()
    assert run(*line, *pairs) == 0
    assert run("evaluate", "recorded", float_bundle.path, "--data", path) == 3
    assert run("evaluate", "recorded", float_bundle.path, "--data", path, *pairs) == 0
    assert run("evaluate", "recorded", float_bundle.path, *pairs) == 2, "--map without a recording"
