"""Each reader on a dataset that the library of its format wrote: every step is what was recorded."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tests import _datasets as datasets
from vlatool.data import reader_of


class Kind(NamedTuple):
    """A format: how a dataset is written, its camera, state and actions, and the package that reads it."""

    write: Callable[[Path], Path]
    camera: str
    state: str
    action: str
    package: str


KINDS = {
    "aloha": Kind(datasets.aloha, "observations/images/cam_high", "observations/qpos", "action", "h5py"),
    "aloha jpeg": Kind(lambda path: datasets.aloha(path, compress=True), "observations/images/cam_wrist",
                       "observations/qpos", "action", "h5py"),
    "aloha file": Kind(lambda path: datasets.aloha(path) / "episode_1.hdf5", "observations/images/cam_high",
                       "observations/qpos", "action", "h5py"),
    "robomimic": Kind(lambda path: datasets.robomimic(path.with_suffix(".hdf5")), "obs/agentview_image",
                      "obs/robot0_eef_pos", "actions", "h5py"),
    "hdf5 of any name": Kind(datasets.robomimic, "obs/agentview_image", "obs/robot0_eef_pos", "actions", "h5py"),
    "zarr 2": Kind(datasets.diffusion_zarr, "img", "state", "action", "zarr"),
    "zarr 3": Kind(lambda path: datasets.diffusion_zarr(path, 3), "img", "state", "action", "zarr"),
    "zarr zip": Kind(lambda path: datasets.diffusion_zarr(path.with_suffix(".zarr.zip"), zipped=True), "img", "state",
                     "action", "zarr"),
    "rlds": Kind(datasets.rlds, "observation/image", "observation/state", "action", "tfrecord"),
    "folder": Kind(datasets.image_folder, "cam", "state", "action", "PIL"),
    "csv": Kind(lambda path: datasets.image_folder(path) / "log.csv", "cam", "state", "action", "PIL"),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_each_step_is_what_was_recorded(tmp_path: Path, name: str):
    kind = KINDS[name]
    pytest.importorskip(kind.package, reason=f"it is read with {kind.package} (extra data)")
    path = kind.write(tmp_path / "data")
    steps = reader_of(path).steps(path)
    rows = np.flatnonzero(datasets.EPISODES == 1) if name == "aloha file" else np.arange(datasets.COUNT)
    assert (len(steps), steps.action) == (len(rows), kind.action)
    np.testing.assert_array_equal(steps.columns[kind.state], datasets.STATE[rows])
    np.testing.assert_array_equal(steps.columns[kind.action], datasets.ACTION[rows])
    np.testing.assert_array_equal(np.diff(steps.episodes), np.diff(datasets.EPISODES[rows]))
    frames = steps.columns[kind.camera]
    order = [0, 1, 2, 7, 8, 3, 0, len(rows) - 1]
    assert [datasets.row_of(pixels) for pixels in frames[order]] == rows[order].tolist()
    lossy = 12 if name == "aloha jpeg" else 0
    assert np.abs(frames[4].astype(int) - datasets.picture(int(rows[4]))).max() <= lossy


def test_the_first_channel_of_an_aloha_jpeg_is_that_of_the_array(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("h5py", reason="it is read with h5py (extra data)")

    def red(row: int, shift: int = 0) -> np.ndarray:
        return np.broadcast_to(np.array([200, 10, 10], np.uint8), (datasets.HEIGHT, datasets.WIDTH, 3))

    monkeypatch.setattr(datasets, "picture", red)
    frames = reader_of(datasets.aloha(tmp_path / "a", compress=True)).steps(tmp_path / "a").columns
    assert np.abs(frames["observations/images/cam_high"][3].astype(int) - red(3)).max() <= 12


def test_a_csv_names_task_and_time(tmp_path: Path):
    pytest.importorskip("PIL", reason="it is read with Pillow (extra data)")
    steps = reader_of(datasets.image_folder(tmp_path / "a")).steps(tmp_path / "a")
    np.testing.assert_allclose(steps.times, datasets.FRAMES / datasets.HZ)
    assert steps.columns["task"][7] == "place the cube, now"
    assert steps.tasks.tolist() == (datasets.EPISODES % 2).tolist()


def test_an_episode_of_rlds_has_a_text_and_numbers_for_each_step(tmp_path: Path):
    pytest.importorskip("tfrecord", reason="it is written with tfrecord (extra dev)")
    columns = reader_of(datasets.rlds(tmp_path / "a")).steps(tmp_path / "a").columns
    assert columns["count"].tolist() == [row * 1000 - 5 for row in range(datasets.COUNT)]
    assert columns["is_first"].tolist() == (datasets.FRAMES == 0).tolist()
    assert columns["language_instruction"][[0, 7]].tolist() == [*datasets.TASKS]
