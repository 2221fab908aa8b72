"""The scripts beside this file in their small form."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from _arm_bundle import arm_bundle
from clients import HERE, observations
from malformed_frames import PROTOCOLS, attack, lerobot_classes
from network_faults import trial

from vlatool.runtime import load
from vlatool.serving import Access, Service
from vlatool.serving.gr00t import Gr00tServer


@pytest.fixture(autouse=True)
def _classes() -> Iterator[None]:
    with lerobot_classes():
        yield


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_frame_ends_a_server(protocol: str):
    found = attack(protocol, 60, seed=5)
    assert found["refused"] > 20


def test_forty_lines_of_gr00t_get_the_actions_of_the_bundle(tmp_path: Path):
    policy = load(arm_bundle(tmp_path / "arm").path, threads=1)
    columns = observations(policy.spec, 3)
    np.savez(tmp_path / "seen.npz", **columns)
    server = Gr00tServer(Service(policy), Access(), 0)
    try:
        words = [server.start(), str(tmp_path / "seen.npz"), str(tmp_path / "done.npz")]
        subprocess.run([sys.executable, str(HERE / "gr00t_robot.py"), *words], check=True, timeout=60)
    finally:
        server.close()
    with np.load(tmp_path / "done.npz") as done:
        assert all(
            np.array_equal(done["chunks"][row], policy.infer({"q": columns["q"][row]}).chunk) for row in range(3)
        )


def test_no_action_for_another_observation_comes_through_a_bad_network():
    found = trial(60, seed=1)
    assert found["of another observation"] == 0
    assert sum(found.get(name, 0) for name in ("right", "not in time", "ServingError")) == 60
