"""A tiny policy of two graphs that integrates a flow: a prefix, and a head that is run in four Euler steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

POLICY = """\
import torch
from torch import nn


class Prefix(nn.Module):
    def __init__(self):
        super().__init__()
        self.see = nn.Linear(3, 16)

    def forward(self, state):
        return torch.tanh(self.see(state))


class Head(nn.Module):
    def __init__(self):
        super().__init__()
        self.body = nn.Sequential(nn.Linear(16 + 2 + 1, 32), nn.GELU(), nn.Linear(32, 2))

    def forward(self, seen, x, t, dt):
        given = torch.cat([seen[:, None].expand(-1, 4, -1), x, t[:, None, None].expand(-1, 4, 1)], -1)
        return x + dt[:, None, None] * (self.body(given) + 3 * x * t[:, None, None])


def make():
    torch.manual_seed(0)
    return {"prefix": Prefix().eval(), "head": Head().eval()}
"""
YAML = """\
schema: 1
name: flow
version: 1.0.0
source: policy.py:make
spec:
  inputs:
    - {name: state, shape: [1, 3], dtype: float32, unit: m}
  outputs:
    - {name: action, shape: [1, 4, 2], dtype: float32, labels: [dx, dy], unit: m}
  control_hz: 10
  chunk: 4
program:
  - graph: prefix
    feeds: {state: state}
    gives: {seen: seen}
  - graph: head
    feeds: {seen: seen, x: x, t: t, dt: dt}
    gives: {next: action}
    repeat: 4
    carry: {action: x}
    schedule: {t: [1.0, 0.75, 0.5, 0.25], dt: [-0.25, -0.25, -0.25, -0.25]}
    noise: {x: {shape: [1, 4, 2]}}
"""


def write_flow(folder: Path) -> Path:
    """Write the policy into a new folder."""
    folder.mkdir()
    (folder / "policy.py").write_text(POLICY)
    (folder / "policy.yaml").write_text(YAML)
    states = np.random.default_rng(0).standard_normal((64, 3)).astype(np.float32)
    np.savez(folder / "calibration.npz", state=states, action=np.zeros((64, 4, 2), np.float32))
    return folder
