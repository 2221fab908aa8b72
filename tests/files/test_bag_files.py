"""Remedies for bags that cannot be read."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from vlatool.buses import QoS
from vlatool.buses.bag import Bag
from vlatool.errors import BusError, DataError
from vlatool.files.bag_files import bag_repair
from vlatool.messages.std_msgs import String
from vlatool.nodes.recordings import open_recording


def record(path: Path) -> None:
    bag = Bag(f":{path}", "recorder")
    send = bag.publisher("/say", String, QoS())
    for word in ("one", "two"):
        send(String(word))
    bag.close()


def test_mcap_without_its_end_is_recovered_with_mcap(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap")
    file = tmp_path / "run/run.mcap"
    file.write_bytes(file.read_bytes()[:-20])
    (tmp_path / "run/metadata.yaml").unlink()
    for path in (tmp_path / "run", file):
        with pytest.raises(BusError) as refusal:
            Bag(str(path), "reader")
        assert refusal.value.fix.endswith(f"mcap recover {file} -o {tmp_path / 'run/run-repaired.mcap'}")


def test_whole_mcap_without_metadata_is_reindexed(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap")
    (tmp_path / "run/metadata.yaml").unlink()
    assert bag_repair(tmp_path / "run").endswith(f"ros2 bag reindex {tmp_path / 'run'}")


@pytest.mark.parametrize("name", ["run.bag", "run.db3"])
def test_bags_of_other_storages_are_reindexed(tmp_path: Path, name: str) -> None:
    record(tmp_path / name)
    path = tmp_path / (name if name.endswith(".bag") else "run/run.db3")
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(BusError) as refusal:
        Bag(str(path), "reader")
    expected = f"rosbag reindex {path}" if path.suffix == ".bag" else f"ros2 bag reindex {tmp_path / 'run'}"
    assert refusal.value.fix.endswith(expected)


def test_name_that_the_recorder_was_given_leads_to_its_directory(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap")
    with pytest.raises(DataError) as refusal:
        open_recording(tmp_path / "run.mcap", "vln")
    assert refusal.value.fix == f"name the directory of the bag: {tmp_path / 'run'}"
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(DataError, match="There is no recording"):
        open_recording(tmp_path / "run.mcap", "vln")
