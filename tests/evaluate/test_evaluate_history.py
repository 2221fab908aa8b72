"""A policy that looks at two moments is given every control step, by an environment and from a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests import _shared
from vlatool.bundle.bundle import Bundle
from vlatool.data import evaluation_recording, recorded_observations
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.evaluate.recorded import run_recorded
from vlatool.export.onnx import ExportOnnx
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.user_code import trust

YAML = """\
schema: 1
name: looks-back
version: 1.0.0
source: policy.py:make
spec:
  inputs:
    - {name: state, shape: [1, 2, 3], dtype: float32, unit: m, history: 2}
  outputs:
    - {name: action, shape: [1, 2, 3], dtype: float32, unit: m}
  control_hz: 10
  chunk: 2
"""
POLICY = """\
import torch
from torch import nn


def make():
    layer = nn.Linear(3, 3, bias=False)
    with torch.no_grad():
        layer.weight.copy_(torch.eye(3))
    return layer
"""
WORLD = """\
import numpy as np


class World:
    def seen(self):
        return {"state": np.full(3, self.at, np.float32)}

    def reset(self, *, seed=None, options=None):
        self.at, self.right = 0, True
        return self.seen(), {}

    def step(self, action):
        self.right &= bool((action == max(0, self.at - 1)).all())
        self.at += 1
        return self.seen(), 0.0, self.at == 9, False, {"success": self.right}


def make(task):
    return World()
"""
LENGTH = 8


def made(folder: Path) -> None:
    """Write the policy, its environment and recordings, and export it."""
    policy = folder / "policy"
    policy.mkdir(parents=True)
    (policy / "policy.yaml").write_text(YAML)
    (policy / "policy.py").write_text(POLICY)
    (policy / "environment.py").write_text(WORLD)
    state = np.random.default_rng(0).standard_normal((4 * LENGTH, 3)).astype(np.float32)
    episode = np.repeat(np.arange(4), LENGTH)
    before = np.where(np.arange(len(state)) % LENGTH, np.arange(len(state)) - 1, np.arange(len(state)))
    action = np.stack([state[before], state], 1)
    for name in ("calibration", "evaluation"):
        np.savez(policy / f"{name}.npz", state=state, episode=episode, action=action)
    trust.allow(policy)
    source = run_transform(TorchModule(policy=policy), None, folder / "source", Context()).bundle
    run_transform(ExportOnnx(), source, folder / "float32", Context())


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.open(_shared.once("looks-back", made) / "float32")


def test_an_episode_gives_every_control_step(bundle: Bundle):
    folder = bundle.path.parent / "policy"
    (outcome,) = run_jobs(bundle, [EpisodesJob("environment.py:make", str(folder), "t", (1,))], "", Context())
    assert (outcome.success, outcome.steps) == (True, 9)


def test_a_recording_gives_the_moments_of_its_episode(bundle: Bundle):
    recording, _ = evaluation_recording(bundle)
    numbers = [0, 3, 8, 9, 20]
    chunks = run_recorded(bundle, recording, numbers, "", Context())
    np.testing.assert_allclose(chunks, recording.actions[numbers], atol=1e-6)


def test_the_golden_observations_hold_all_moments(bundle: Bundle):
    policy = load(bundle.path, threads=1)
    assert policy.golden_error < 1e-6
    observation = recorded_observations(bundle, 8)[5]
    assert observation["state"].shape == (2, 3)
    np.testing.assert_allclose(policy.infer(observation).chunk, observation["state"], atol=1e-6)


def test_a_quantized_policy_is_calibrated_by_moments(bundle: Bundle, tmp_path: Path):
    made = run_transform(StaticInt8(samples=16), bundle, tmp_path / "int8", Context()).bundle
    policy = load(made.path, threads=1)
    policy.observe({"state": np.full(3, 0.5)})
    np.testing.assert_allclose(policy.infer({"state": np.full(3, -0.5)}).chunk[:, 0], [0.5, -0.5], atol=0.05)
