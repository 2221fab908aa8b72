"""Environments that write into arrays which vlatool gave them, or gave vlatool: nothing that is measured changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from _numbered import EchoController, NumberedPolicy

from tests._reach import TREMBLES, bundle_of
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.episodes.body import Body
from vlatool.episodes.disturbances import DELAY, DisturbedController
from vlatool.episodes.environment import World
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.runtime.control.late import LateController
from vlatool.stage.base import Context

STEP = "    def step(self, action):\n"
SCALES = STEP + "        own = np.array(action)\n        action *= 10\n        np.clip(action, -1, 1, out=action)\n"
SCALES += "        action = own\n"
POSITION = '"position": self.at, "success"'
REUSES = '"position": BUFFER, "success"'


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return bundle_of(tmp_path_factory.mktemp("in-place"), TREMBLES)


def played(bundle: Bundle, folder: Path, code: str, **options: object):
    folder.mkdir()
    (folder / "environment.py").write_text(code)
    job = EpisodesJob("environment.py:make", str(folder), "near", (3, 4), show=True, **options)
    return run_jobs(bundle, [job], "", Context())


@pytest.mark.parametrize("latency_ms", [0.0, 130.0])
def test_what_is_measured_is_what_was_commanded(bundle: Bundle, tmp_path: Path, latency_ms: float):
    """The world acts on the action as it was, and then on nothing else, so that both worlds are the same."""
    code = (bundle.path.parent / "policy/environment.py").read_text()
    assert STEP in code
    plain = played(bundle, tmp_path / "plain", code, latency_ms=latency_ms)
    scaled = played(bundle, tmp_path / "scaled", code.replace(STEP, SCALES), latency_ms=latency_ms)
    assert scaled == plain
    assert plain[0].motion["action_rate"] > 0


def test_a_buffer_that_is_reused_for_the_position_is_a_position_each(bundle: Bundle, tmp_path: Path):
    code = (bundle.path.parent / "policy/environment.py").read_text()
    reuses = code.replace(POSITION, REUSES).replace("        self.steps += 1\n", "        BUFFER[:] = self.at\n"
                          "        self.steps += 1\n") + "\nBUFFER = np.zeros(2)\n"  # fmt: skip
    assert reuses.count("BUFFER") == 3
    plain = played(bundle, tmp_path / "plain", code)
    assert played(bundle, tmp_path / "reuses", reuses) == plain
    assert plain[0].motion["path_length"] > 0


def test_an_action_that_is_repeated_is_the_one_that_was_commanded():
    """An absolute action is held while the policy thinks; the environment wrote zeros over what it was given."""
    spec = PolicySpec((TensorSpec("state", (1, 2)),), (TensorSpec("a", (1, 1, 2), mode="absolute"),), 10.0, 1)

    class Eats:
        def reset(self, *, seed=None):
            return np.zeros(2), {}

        def step(self, action):
            action[:] = 0
            return np.zeros(2), 0.0, False, False, {}

    acting, body = LateController(NumberedPolicy(spec), delay=3), Body(spec)
    world = World(Eats(), "any", spec)
    body.look({})
    for _ in range(4):
        action = acting.act({"t": 5})
        world.step(action)
        body.add_action(action, acting.fresh)
        body.look({})
    np.testing.assert_array_equal(body.track().actions, [[500, 500.5]] * 4)


@pytest.mark.parametrize("buffer", [np.zeros(2), [0.0, 0.0]], ids=["array", "list"])
def test_an_observation_that_comes_late_is_as_it_was(buffer):
    spec = PolicySpec((TensorSpec("state", (1, 2)),), (TensorSpec("a", (1, 1, 2)),), 20.0, 1)
    acting = DisturbedController(EchoController("state"), spec, DELAY, 1.0)
    times = []
    for step in range(3):
        buffer[0] = float(step)
        times.append(float(acting.act({"state": buffer})[0]))
    assert times == [0.0, 0.0, 1.0]
