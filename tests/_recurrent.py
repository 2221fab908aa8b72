"""Small policies that keep values from step to step, and recordings of their episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.export.onnx import ExportOnnx
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.user_code import trust

LENGTH = 12
"""Steps of an episode."""
YAML = """\
schema: 1
name: recurrent
version: 1.0.0
source: policy.py:make
arguments: {kind: KIND}
spec:
  inputs:
    - {name: target, shape: [1, 2], dtype: float32, unit: m}
  outputs:
    - {name: action, shape: [1, 1, 2], dtype: float32, unit: m, labels: [dx, dy], mode: delta}
  control_hz: 10
  chunk: 1
program:
  - graph: main
    feeds: {target: target, memory: memory}
    gives: {action: action, next_memory: memory}
    keep: {memory: {shape: SHAPE, dtype: float32}}
"""
KEEP = "    keep: {memory: {shape: None, dtype: float32}}\n"
ENVIRONMENT = "environment: {make: environment.py:make, tasks: [t]}\n"
BATCHES = "training: train.py:batches\n"
POLICY = '''\
import torch
from torch import nn


class Delayed(nn.Module):
    """Acts on what it was given two steps before."""

    def __init__(self):
        super().__init__()
        self.out = nn.Linear(2, 2, bias=False)
        with torch.no_grad():
            self.out.weight.copy_(torch.tensor([[1.0, 0.0], [0.0, -1.0]]))

    def forward(self, target, memory):
        return self.out(memory[:, :2])[:, None], torch.cat([memory[:, 2:], target], 1)


class Elman(nn.Module):
    """Can learn to."""

    def __init__(self):
        super().__init__()
        self.seen, self.kept, self.out = nn.Linear(2, 16), nn.Linear(16, 16, bias=False), nn.Linear(16, 2)

    def forward(self, target, memory):
        memory = torch.tanh(self.seen(target) + self.kept(memory))
        return self.out(memory)[:, None], memory


class Gru(nn.Module):
    """Two layers of torch's, whose state has the batch in its second axis."""

    def __init__(self):
        super().__init__()
        self.gru, self.out = nn.GRU(2, 8, num_layers=2), nn.Linear(8, 2)

    def forward(self, target, memory):
        seen, memory = self.gru(target[None], memory)
        return self.out(seen[0])[:, None], memory


class Hidden(nn.Module):
    """64 hidden units: 32 read the target and matter little, 32 read the memory and decide the action."""

    def __init__(self):
        super().__init__()
        self.i, self.o = nn.Linear(10, 64, bias=False), nn.Linear(64, 2, bias=False)
        self.m = nn.Linear(2, 8)
        with torch.no_grad():
            self.i.weight[:32, 2:] = 0
            self.i.weight[32:, :2] = 0
            self.o.weight[:, :32] *= 0.05

    def forward(self, target, memory):
        hidden = torch.relu(self.i(torch.cat([target, memory], 1)))
        return self.o(hidden)[:, None], torch.tanh(self.m(target)) + 0.5 * memory


class Writers(nn.Module):
    """64 hidden units: 32 write what is remembered, on which the action alone depends; 32 hardly add to the action."""

    def __init__(self):
        super().__init__()
        self.i, self.o, self.m = nn.Linear(2, 64), nn.Linear(64, 2, bias=False), nn.Linear(64, 8, bias=False)
        self.a = nn.Linear(8, 2)
        with torch.no_grad():
            self.m.weight[:, :32] = 0
            self.o.weight[:, 32:] = 0
            self.o.weight[:, :32] *= 0.05

    def forward(self, target, memory):
        hidden = torch.relu(self.i(target))
        return (self.a(memory) + self.o(hidden))[:, None], 0.5 * memory + self.m(hidden)


class Sum(nn.Module):
    """Adds up what it was given."""

    def __init__(self):
        super().__init__()
        self.out = nn.Linear(2, 2)

    def forward(self, target, memory):
        memory = memory + target
        return self.out(memory)[:, None], memory


class Hiding(nn.Module):
    """Keeps what it was given, and does not say so."""

    def __init__(self):
        super().__init__()
        self.i, self.o, self.before = nn.Linear(2, 32), nn.Linear(32, 2), 0.0

    def forward(self, target):
        self.before = 0.5 * self.before + target.mean().item()
        return self.o(torch.relu(self.i(target + self.before)))[:, None]


class Plain(nn.Module):
    """Keeps nothing."""

    def __init__(self):
        super().__init__()
        self.out = nn.Linear(2, 2)

    def forward(self, target):
        return 0 * self.out(target)[:, None]


def make(kind):
    torch.manual_seed(0)
    kinds = {"delayed": Delayed, "sum": Sum, "elman": Elman, "gru": Gru, "hidden": Hidden, "writers": Writers}
    kinds |= {"plain": Plain, "again": Delayed, "hiding": Hiding}
    return kinds[kind]().eval()
'''
SHAPES = {
    "delayed": [1, 4],
    "again": [1, 4],
    "elman": [1, 16],
    "gru": [2, 1, 8],
    "hidden": [1, 8],
    "writers": [1, 8],
    "sum": [1, 2],
}


def write_recurrent(
    folder: Path, kind: str, *, count: int = 20, episodes: bool = True, more: str = "", code: str = ""
) -> Path:
    """Write a policy that keeps values, and a recording of so many episodes; none of 0.

    Args:
        folder: New.
        kind: Of the module.
        count: Episodes.
        episodes: Whether the recording says where they begin.
        more: Further line of ``policy.yaml``, which names a file.
        code: Of that file.
    """
    folder.mkdir(parents=True)
    if code:
        (folder / ("train.py" if more == BATCHES else "environment.py")).write_text(code)
    (folder / "policy.py").write_text(POLICY)
    described = YAML.replace("KIND", kind).replace("SHAPE", str(SHAPES.get(kind))) + more
    if kind in ("plain", "hiding"):
        described = described.replace(", memory: memory", "").replace(", next_memory: memory", "").replace(KEEP, "")
    if count:
        described += "calibration: calibration.npz\n"
        np.savez(folder / "calibration.npz", **recorded(count, episodes=episodes))
    (folder / "policy.yaml").write_text(described)
    return folder


def recorded(count: int, seed: int = 0, *, episodes: bool = True) -> dict[str, np.ndarray]:
    """Observations of so many episodes, and what ``delayed`` does."""
    random = np.random.default_rng(seed)
    target = random.uniform(-1, 1, (count, LENGTH, 2)).astype(np.float32)
    if not episodes:
        target = target.reshape(1, -1, 2)
    action = np.concatenate([np.zeros_like(target[:, :2]), target[:, :-2]], 1) * np.float32([1, -1])
    rows = {"target": target.reshape(-1, 2), "action": action.reshape(-1, 2)}
    return rows | ({"episode": np.arange(count * LENGTH) // LENGTH} if episodes else {})


def recurrent_bundle(folder: Path, kind: str, **options) -> Bundle:
    """Make the source bundle of such a policy."""
    policy = write_recurrent(folder, kind, **options)
    trust.allow(policy)
    return run_transform(TorchModule(policy=policy), None, folder.parent / f"{folder.name}-source", Context()).bundle


def exported(folder: Path, kind: str, **options) -> Bundle:
    """Make the float32 bundle of such a policy."""
    source = recurrent_bundle(folder, kind, **options)
    return run_transform(ExportOnnx(), source, folder.parent / f"{folder.name}-float", Context()).bundle
