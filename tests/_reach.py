"""A point that is to be moved to a goal, and policies that do it well, roughly, or too eagerly."""

from __future__ import annotations

import shutil
from pathlib import Path

from _shared import once

from vlatool.bundle.bundle import Bundle
from vlatool.export.onnx import ExportOnnx
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.user_code import trust

YAML = """\
schema: 1
name: reach
version: 1.0.0
source: policy.py:make
arguments: {gain: %s, tremble: %s}
spec:
  inputs: [{name: state, shape: [1, 4], unit: m}]
  outputs: [{name: action, shape: [1, 2], unit: m, mode: delta}]
  control_hz: 20
  chunk: 1
environment: {make: environment.py:make, tasks: [near, far]}
"""
POLICY = """\
import torch
from torch import nn

class Reach(nn.Module):
    def __init__(self, gain, tremble):
        super().__init__()
        self.away = nn.Linear(4, 2, bias=False)
        self.away.weight.data = gain * torch.tensor([[-1.0, 0, 1, 0], [0, -1, 0, 1]])
        self.tremble = tremble

    def forward(self, state):
        return self.away(state) + self.tremble * torch.sin(7e3 * state[:, :2] + 1.0)

def make(gain, tremble):
    return Reach(gain, tremble)
"""
ENVIRONMENT = """\
import numpy as np

class World:
    disturbances = ("push",)

    def __init__(self, task):
        self.size = {"near": 0.2, "far": 1.0}[task]
        self.push = (0.0, 0)

    def disturb(self, kind, strength, seed):
        if kind not in self.disturbances:
            raise ValueError(f"unknown disturbance {kind!r}")
        self.push = (strength, seed)

    def reset(self, *, seed=None):
        random = np.random.default_rng(seed)
        self.at, self.goal = np.zeros(2), self.size * random.normal(size=2)
        strength, drawn = self.push
        self.at = self.at + 0.1 * strength * np.random.default_rng((drawn, 9)).normal(size=2)
        self.steps = 0
        return self.seen(), {"position": self.at, "shortest_path": float(np.linalg.norm(self.goal - self.at))}

    def seen(self):
        return {"state": np.concatenate([self.at, self.goal]).astype(np.float32)}

    def step(self, action):
        self.at = self.at + np.asarray(action, np.float64)
        self.steps += 1
        there = bool(np.linalg.norm(self.goal - self.at) < 0.05)
        over = self.steps >= 40
        return self.seen(), 0.0, False, over, {"position": self.at, "success": there}

def make(task):
    return World(task)
"""
GOOD, TREMBLES, EAGER = (0.2, 0.0), (0.2, 0.01), (0.95, 0.0)
"""Gain, and how much it trembles: all of them are there in the end, as long as nothing comes between."""


def folder_of(folder: Path, kind: tuple[float, float] = GOOD) -> Path:
    """Write a policy into a new folder, and return it."""
    folder.mkdir(parents=True)
    for name, text in {"policy.yaml": YAML % kind, "policy.py": POLICY, "environment.py": ENVIRONMENT}.items():
        (folder / name).write_text(text)
    return folder


def bundle_of(folder: Path, kind: tuple[float, float] = GOOD) -> Bundle:
    """Return the bundle of a policy of a kind, in a new folder that holds the policy, too."""

    def make(place: Path) -> None:
        policy = folder_of(place / "policy", kind)
        source = run_transform(TorchModule(policy=policy), None, place / "module", Context()).bundle
        run_transform(ExportOnnx(), source, place / "bundle", Context())

    shutil.copytree(once(f"reach-{kind[0]}-{kind[1]}", make), folder, dirs_exist_ok=True)
    trust.allow(folder / "policy")
    return Bundle.open(folder / "bundle")
