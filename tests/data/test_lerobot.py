"""Datasets in the layout of LeRobot; tests/validation/foreign holds the reader against those that LeRobot wrote."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import _datasets as datasets
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import read_recording, reader_of
from vlatool.data.lerobot import LerobotDataset
from vlatool.errors import DataError

pytest.importorskip("pyarrow", reason="LeRobot's datasets are read with pyarrow (extra data)")
pytest.importorskip("av", reason="videos are read with PyAV (extra data)")
SPEC = PolicySpec(
    (
        TensorSpec("top", (1, datasets.HEIGHT, datasets.WIDTH, 3), "uint8"),
        TensorSpec("state", (1, 3)),
        TensorSpec("say", (1, 4), "int64", kind="text", tokenizer="words.json", max_tokens=4),
    ),
    (TensorSpec("action", (1, 3, 2)),),
    10.0,
    3,
)
KINDS: dict[str, Callable[[Path], Path]] = {
    "v3": datasets.lerobot_v3,
    "v3 av1": lambda path: datasets.lerobot_v3(path, codec="libsvtav1"),
    "v3 pictures": lambda path: datasets.lerobot_v3(path, "image"),
    "v2": datasets.lerobot_v2,
    "v2 pictures": lambda path: datasets.lerobot_v2(path, "image"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_step_is_what_was_recorded(tmp_path: Path, kind: str):
    steps = reader_of(KINDS[kind](tmp_path / "data")).steps(tmp_path / "data")
    assert (len(steps), steps.hz, steps.action) == (datasets.COUNT, 10, "action")
    assert {*steps.columns} == {
        "observation.images.top",
        "observation.images.wrist",
        "observation.state",
        "action",
        "task",
    }
    np.testing.assert_array_equal(steps.columns["observation.state"], datasets.STATE)
    np.testing.assert_array_equal(steps.columns["action"], datasets.ACTION)
    np.testing.assert_array_equal(steps.episodes, datasets.EPISODES)
    np.testing.assert_allclose(steps.times, datasets.FRAMES / 10, atol=1e-6)
    assert steps.columns["task"].read(5, 2).tolist() == [*datasets.TASKS]
    for camera in ("top", "wrist"):
        frames = steps.columns[f"observation.images.{camera}"]
        order = [*range(datasets.COUNT), 18, 3, 2, 7, 12, 12, 0]
        assert [datasets.row_of(frames[row]) for row in order] == order
        assert [datasets.row_of(pixels) for pixels in frames[[1, 16, 4]]] == [1, 16, 4]


def test_an_encoder_leaves_the_tests_no_real_time_priority(tmp_path: Path):
    before = os.sched_getscheduler(0)
    datasets.write_video(tmp_path / "video.mp4", range(4), "libsvtav1")
    assert os.sched_getscheduler(0) == before


def test_a_recording_for_a_policy(tmp_path: Path):
    recording = read_recording(datasets.lerobot_v3(tmp_path / "data"), SPEC)
    observation = recording.observation(7)
    assert (datasets.row_of(observation["top"]), observation["say"]) == (7, datasets.TASKS[1])
    np.testing.assert_array_equal(recording.actions[4], datasets.ACTION[[4, 5, 5]])
    assert len(recording.with_whole_chunks()) == datasets.COUNT - 2 * len(datasets.LENGTHS)


def change(file: str, **values: Any) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        info = json.loads((folder / file).read_text())
        (folder / file).write_text(
            json.dumps({name: value for name, value in {**info, **values}.items() if value != ""})
        )

    return edit


WRONG_INFO = {
    "another version": (change("meta/info.json", codebase_version="v1.6"), "codebase_version 'v1.6'; read are v2.0"),
    "no features": (change("meta/info.json", features=""), "has no mapping 'features'"),
    "no rate": (change("meta/info.json", fps=0), "has the fps 0; wanted a number above 0"),
    "more steps": (change("meta/info.json", total_frames=25), "holds 19 steps; its meta/info.json says 25"),
    "more episodes": (change("meta/info.json", total_episodes=5), "holds 3 episodes; its meta/info.json says 5"),
    "elsewhere": (change("meta/info.json", data_path="../{file_index}.parquet"), "names a file outside the dataset"),
    "root": (change("meta/info.json", video_path="/etc/{video_key}.mp4"), "names a file outside the dataset"),
    "code": (change("meta/info.json", data_path="{file_index.__class__}/{x}"), "'x', which is unknown|not found"),
}


@pytest.mark.parametrize("wrong", WRONG_INFO)
def test_what_info_json_says_is_not_believed(tmp_path: Path, wrong: str):
    edit, message = WRONG_INFO[wrong]
    edit(datasets.lerobot_v3(tmp_path / "data"))
    with pytest.raises(DataError, match=message):
        LerobotDataset().steps(tmp_path / "data")


def test_a_camera_whose_video_is_shorter_than_its_steps_is_named(tmp_path: Path):
    folder = datasets.lerobot_v3(tmp_path / "data")
    file = folder / "videos/observation.images.top/chunk-000/file-001.mp4"
    file.unlink()
    datasets.write_video(file, [15, 16])
    frames = LerobotDataset().steps(folder).columns["observation.images.top"]
    assert datasets.row_of(frames[16]) == 16
    for row in (17, 18):
        with pytest.raises(DataError, match=r"file-001.mp4 has no frame at 0.[23]00 s: it ends before"):
            frames.read(row, 1)
    assert datasets.row_of(frames[15]) == 15, "it goes on afterwards"
