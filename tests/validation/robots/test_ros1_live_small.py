"""The small forms of ``ros1_live.py`` and ``ros1_launch.py``, where ROS 1 has been unpacked into ``out/ros1``."""

from __future__ import annotations

import ctypes.util
from pathlib import Path

import pytest
from _full import small_or_full
from _ros1 import ROOT, Rows, environment, is_prepared
from _ros1_processes import Programs
from ros1_launch import CODES, try_launch
from ros1_live import PATHS, try_live

FOLDER = ROOT / "out/ros1"
pytestmark = [
    pytest.mark.skipif(
        not is_prepared(FOLDER), reason="run tests/validation/robots/ros1_bus.py once: it unpacks ROS 1"
    ),
    pytest.mark.skipif(not any(map(ctypes.util.find_library, ("EGL", "OSMesa"))), reason="nothing renders"),
]


def wrong(rows: Rows) -> list[str]:
    return [f"{what}: {said}" for what, said, right in rows if not right]


@pytest.mark.parametrize(
    "name", small_or_full(("cloud-follower",), ("roi-follower", "cloud-follower", "safety-monitor"))
)
def test_a_live_run_is_replayed_from_the_bags_of_rosbag_and_of_vlatool(tmp_path: Path, name: str):
    rows: Rows = []
    with Programs(FOLDER, environment(FOLDER), tmp_path) as programs:
        try_live(programs, name, (), small_or_full(1.5, 6.0), rows, small_or_full(("all", "ours"), tuple(PATHS)))
    assert len(rows) > 3
    assert not wrong(rows)


@pytest.mark.parametrize("end", small_or_full(("Ctrl-C",), tuple(CODES)))
def test_roslaunch_names_remaps_and_ends_a_controller_which_brings_the_robot_to_rest(tmp_path: Path, end: str):
    rows: Rows = []
    with Programs(FOLDER, environment(FOLDER), tmp_path) as programs:
        try_launch(programs, end, rows)
    assert len(rows) > 2
    assert not wrong(rows)
