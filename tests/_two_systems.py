"""A tiny policy of two systems: one that sees and remembers, and one that denoises actions from what it gave."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
from _shared import once

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

POLICY = """\
import torch
from torch import nn


class Think(nn.Module):
    def __init__(self):
        super().__init__()
        self.see, self.remember = nn.Linear(3, 16), nn.Linear(16, 16)

    def forward(self, scene, memory):
        thought = torch.tanh(self.see(scene) + self.remember(memory))
        return thought, thought


class Act(nn.Module):
    def __init__(self):
        super().__init__()
        self.body = nn.Sequential(nn.Linear(16 + 2 + 2 + 1, 32), nn.GELU(), nn.Linear(32, 2))

    def forward(self, thought, state, x, t, dt):
        seen = torch.cat([thought, state], -1)[:, None].expand(-1, 4, -1)
        given = torch.cat([seen, x, t[:, None, None].expand(-1, 4, 1)], -1)
        return x + dt[:, None, None] * (self.body(given) + 3 * x * t[:, None, None])


def make():
    torch.manual_seed(0)
    return {"think": Think().eval(), "act": Act().eval()}
"""
YAML = """\
schema: 1
name: two-systems
version: 1.0.0
source: policy.py:make
spec:
  inputs:
    - {name: scene, shape: [1, 3], dtype: float32, unit: "1"}
    - {name: state, shape: [1, 2], dtype: float32, unit: m, labels: [x, y]}
  outputs:
    - {name: action, shape: [1, 4, 2], dtype: float32, labels: [x, y], unit: m, mode: absolute}
  control_hz: 100
  chunk: 4
  execute: 1
program:
  - graph: think
    feeds: {scene: scene, memory: memory}
    gives: {thought: thought, next: memory}
    keep: {memory: {shape: [1, 16]}}
    slow: {max_age_ms: 100, hz: 25}
  - graph: act
    feeds: {thought: thought, state: state, x: x, t: t, dt: dt}
    gives: {next: action}
    repeat: 4
    carry: {action: x}
    schedule: {t: [1.0, 0.75, 0.5, 0.25], dt: [-0.25, -0.25, -0.25, -0.25]}
    noise: {x: {shape: [1, 4, 2]}}
"""


def write_two_systems(folder: Path) -> Path:
    """Write the policy into a new folder."""
    folder.mkdir(parents=True)
    (folder / "policy.py").write_text(POLICY)
    (folder / "policy.yaml").write_text(YAML)
    random = np.random.default_rng(0)
    scene, state = (random.standard_normal((64, width)).astype(np.float32) for width in (3, 2))
    np.savez(folder / "calibration.npz", scene=scene, state=state, action=np.zeros((64, 4, 2), np.float32))
    return folder


def _export(folder: Path) -> None:
    from vlatool.export.onnx import ExportOnnx
    from vlatool.sources.torch_module import TorchModule
    from vlatool.user_code import trust

    policy = write_two_systems(folder / "policy")
    trust.allow(policy)
    source = run_transform(TorchModule(policy=policy), None, folder / "source", Context()).bundle
    run_transform(ExportOnnx(), source, folder / "bundle", Context())


@functools.cache
def two_systems() -> Bundle:
    """Return the exported policy; read only."""
    return Bundle.open(once("two-systems", _export) / "bundle")


def observations(count: int, seed: int = 1) -> list[dict[str, np.ndarray]]:
    """Return the observations of an episode: scene (3,), state (2,)."""
    random = np.random.default_rng(seed)
    return [
        {name: random.standard_normal(width).astype(np.float32) for name, width in (("scene", 3), ("state", 2))}
        for _ in range(count)
    ]


def written_graphs(
    folder: Path, texts: dict[str, str], program: tuple[ProgramStep, ...], inputs: tuple[TensorSpec, ...]
) -> Bundle:
    """Seal a bundle of graphs that are written as text, without golden file; its action is (1, 2) at 10 Hz."""
    (folder / "graphs").mkdir(parents=True)
    for name, text in texts.items():
        model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}')
        onnx.save(model, str(folder / f"graphs/{name}.onnx"))
    spec = PolicySpec(inputs, (TensorSpec("action", (1, 2)),), 10.0)
    sealed = seal(folder, Manifest("written", "1", spec, program=program))
    graphs = {name: Graph(f"graphs/{name}.onnx", opset=20) for name in texts}
    return seal(folder, Manifest(**{**vars(sealed.manifest), "graphs": graphs}))
