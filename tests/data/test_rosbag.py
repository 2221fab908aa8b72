"""Bags that rosbags wrote, of ROS 2 in both storages and of ROS 1."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import _datasets as datasets
from vlatool.data import reader_of
from vlatool.data.rosbag import _nearest
from vlatool.errors import DataError

pytest.importorskip("rosbags", reason="bags are read with rosbags (extra data)")
ROWS = np.arange(datasets.COUNT)


def read(path: Path) -> Any:
    return reader_of(path).steps(path)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_topics_are_columns_at_the_times_of_the_slowest_camera(tmp_path: Path, kind: str):
    steps = read(datasets.rosbag(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind))
    assert len(steps) == datasets.COUNT
    np.testing.assert_allclose(steps.times, ROWS / 10, atol=1e-6)
    np.testing.assert_allclose(steps.columns["/joint_states.position"][:, 0], ROWS / 10, atol=1e-9)
    np.testing.assert_allclose(steps.columns["/arm/cmd.linear"], np.stack([ROWS / 10, ROWS * 0 + 2, ROWS * 0], 1))
    assert "/joint_states.effort" not in steps.columns, "nothing was recorded of it"
    for camera in ("/cam/raw", "/cam/jpeg"):
        order = [0, 5, 6, 7, 18, 2, 2, 17]
        frames = [steps.columns[camera][row] for row in order]
        assert [datasets.row_of(pixels) for pixels in frames] == order
        np.testing.assert_array_equal(frames[1], datasets.picture(5))
    assert steps.action == "/arm/cmd.linear"


def test_a_storage_file_is_a_bag_and_a_directory_of_bags_is_several_episodes(tmp_path: Path):
    folder = tmp_path / "all"
    folder.mkdir()
    for number in range(2):
        datasets.rosbag(folder / f"run_{number}")
    assert len(read(next((folder / "run_0").glob("*.mcap")))) == datasets.COUNT
    steps = read(folder)
    assert (len(steps), np.unique(steps.episodes).tolist()) == (2 * datasets.COUNT, [0, 1])
    assert [datasets.row_of(pixels) for pixels in steps.columns["/cam/raw"][[3, 20, 37]]] == [3, 1, 18]
    assert steps.times[datasets.COUNT] == 0


def test_pixels_are_handed_on_in_the_order_of_their_encoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    red = np.broadcast_to(np.array([200, 10, 30], np.uint8), (datasets.HEIGHT, datasets.WIDTH, 3))
    monkeypatch.setattr(datasets, "picture", lambda row: red)
    assert read(datasets.rosbag(tmp_path / "a", encoding="bgr8")).columns["/cam/raw"][3][0, 0].tolist() == [30, 10, 200]


def test_steps_without_a_message_near_them_are_left_out_and_counted(tmp_path: Path):
    steps = read(datasets.rosbag(tmp_path / "a", gap=True))
    (note,) = steps.notes
    assert "7 of 19 steps are left out: a topic has no message within 0.2 s" in note
    assert len(steps) == 12
    ages = np.abs(steps.columns["/joint_states.position"][:, 0] - steps.times)
    assert ages.max() <= 0.2


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "yuv422"])
def test_an_encoding_that_is_not_read_is_named(tmp_path: Path, encoding: str):
    with pytest.raises(DataError, match=f"'/cam/raw' in .* has the encoding '{encoding}'"):
        read(datasets.rosbag(tmp_path / "a", encoding=encoding))


@pytest.mark.parametrize("name", ["a/msg/B:\n  open('{0}', 'w')\nclass C", "a/msg/B(open('{0}', 'w'))", "../msg/B"])
def test_a_type_whose_name_is_code_is_refused_before_it_runs(tmp_path: Path, name: str):
    from rosbags import rosbag1

    written = tmp_path / "ran"
    with rosbag1.Writer(tmp_path / "a.bag") as writer:
        named = name.format(written)
        topic = writer.add_connection("/x", named, msgdef="uint8 x", md5sum="0" * 32)
        writer.write(topic, 1, b"x")
    with pytest.raises(DataError, match=r"has a type with the name"):
        read(tmp_path / "a.bag")
    assert not written.exists()


def test_the_nearest_stamp_is_found_in_any_order():
    random = np.random.default_rng(0)
    stamps, times = random.random(50), random.random(200)
    wanted = np.abs(stamps[None] - times[:, None]).min(axis=1)
    np.testing.assert_allclose(np.abs(stamps[_nearest(stamps, times)] - times), wanted)
    assert _nearest(stamps[:1], times).tolist() == [0] * 200


def test_bag_that_its_recorder_has_not_finished_is_named(tmp_path: Path):
    path = tmp_path / "run.bag.active"
    path.write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(DataError, match="has no index yet") as refusal:
        read(path)
    assert f"rosbag reindex {path}, then mv {path} {tmp_path / 'run.bag'}" in refusal.value.fix
