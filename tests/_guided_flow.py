"""A flow policy that joins its chunks itself: each denoising step corrects its velocity towards the last chunk's rest.

It denoises exactly (no training): its actions are a mixture of two Gaussians along a path, above and below it, so that
two draws of noise often take different sides. The correction is that of real-time chunking (Black, Galliker and Levine
2025, arXiv 2506.07339, equations 2 to 5), with the vector-Jacobian product written out, as a graph has no autograd.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from _shared import once

from vlatool.bundle.bundle import Bundle
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

CHUNK, STEPS, SIDE, SPREAD, LARGEST_WEIGHT = 16, 10, 0.5, 0.05, 10.0
"""Actions, denoising steps, distance of both modes from the path, their standard deviation, largest guidance weight."""
POLICY = f"""\
import torch
from torch import nn

CHUNK, SIDE, SPREAD, LARGEST_WEIGHT = {CHUNK}, {SIDE}, {SPREAD}, {LARGEST_WEIGHT}


class Step(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("places", torch.arange(CHUNK, dtype=torch.float32))
        self.register_buffer("sides", torch.tensor([SIDE, -SIDE])[:, None, None])

    def modes(self, t):
        at = t[0, 0] + self.places
        path = torch.stack([torch.sin(at / 10), torch.cos(at / 10)], -1)
        return path[None] + self.sides

    def denoised(self, x, tau, t):
        "The expected actions, how much of the noise is left in them, the modes, their weights and the variance."
        modes = self.modes(t)
        variance = (1 - tau) ** 2 + (tau * SPREAD) ** 2
        left = tau * SPREAD**2 / variance
        away = x - tau * modes
        weights = torch.softmax(-(away**2).sum((1, 2)) / (2 * variance), 0)[:, None, None]
        expected = modes + left * away
        return (weights * expected).sum(0, keepdim=True), left, modes, weights, expected, variance

    def pulled(self, error, x, tau, t):
        "The error times the Jacobian of the expected actions."
        _, left, modes, weights, expected, variance = self.denoised(x, tau, t)
        centre = (weights * modes).sum(0, keepdim=True)
        along = (error * expected).sum((1, 2), keepdim=True)
        turned = (weights * along * (modes - centre)).sum(0, keepdim=True) * tau / variance
        return left * error + turned

    def wanted(self, delay, horizon):
        "How much each action is to be that of the last chunk: 1 while it is executed, then less, 0 after its end."
        start, end = delay.to(torch.float32), horizon.to(torch.float32)
        share = ((end - self.places) / (end - start + 1)).clamp(0, 1)
        soft = share * (torch.exp(share) - 1) / (torch.e - 1)
        return torch.where(self.places < torch.minimum(start, end), torch.ones_like(soft), soft)[None, :, None]

    def forward(self, x, tau, dt, t, prev_chunk_left_over, inference_delay, execution_horizon):
        expected = self.denoised(x, tau, t)[0]
        velocity = (expected - x) / (1 - tau)
        error = (prev_chunk_left_over - expected) * self.wanted(inference_delay, execution_horizon)
        rest = (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)
        weight = torch.clamp((1 - tau) / (tau * rest + 1e-6), max=LARGEST_WEIGHT)
        return x + dt * (velocity + weight * self.pulled(error, x, tau, t))


def make():
    return {{"step": Step().eval()}}
"""
YAML = f"""\
schema: 1
name: guided-flow
version: 1.0.0
source: policy.py:make
spec:
  inputs:
    - {{name: t, shape: [1, 1], dtype: float32, unit: "1"}}
    - {{name: prev_chunk_left_over, shape: [1, {CHUNK}, 2], dtype: float32, unit: m}}
    - {{name: inference_delay, shape: [1], dtype: int64, unit: "1"}}
    - {{name: execution_horizon, shape: [1], dtype: int64, unit: "1"}}
  outputs:
    - {{name: action, shape: [1, {CHUNK}, 2], dtype: float32, labels: [x, y], unit: m, mode: absolute}}
  control_hz: 20
  chunk: {CHUNK}
  execute: 4
program:
  - graph: step
    feeds: {{x: x, tau: tau, dt: dt, t: t, prev_chunk_left_over: prev_chunk_left_over,
            inference_delay: inference_delay, execution_horizon: execution_horizon}}
    gives: {{next: action}}
    repeat: {STEPS}
    carry: {{action: x}}
    schedule: {{tau: {[number / STEPS for number in range(STEPS)]}, dt: {[1 / STEPS] * STEPS}}}
    noise: {{x: {{shape: [1, {CHUNK}, 2]}}}}
"""


def _export(folder: Path) -> None:
    from vlatool.export.onnx import ExportOnnx
    from vlatool.sources.torch_module import TorchModule
    from vlatool.user_code import trust

    policy = folder / "policy"
    policy.mkdir(parents=True)
    (policy / "policy.py").write_text(POLICY)
    (policy / "policy.yaml").write_text(YAML)
    random = np.random.default_rng(0)
    rests = random.standard_normal((16, CHUNK, 2)).astype(np.float32)
    times = random.uniform(0, 60, (16, 1)).astype(np.float32)
    np.savez(policy / "calibration.npz", t=times, prev_chunk_left_over=rests, action=rests,
             inference_delay=np.full((16,), 3), execution_horizon=np.full((16,), 8))  # fmt: skip
    trust.allow(policy)
    source = run_transform(TorchModule(policy=policy), None, folder / "source", Context()).bundle
    run_transform(ExportOnnx(), source, folder / "bundle", Context())


@functools.cache
def guided_flow() -> Bundle:
    """Return the exported policy; read only."""
    return Bundle.open(once("guided-flow", _export) / "bundle")


def by_autograd(seen: dict[str, Any], noise: np.ndarray) -> np.ndarray:
    """Return the chunk, (T, A), with the Jacobian of torch in the place of the one that is written out."""
    import torch

    space: dict[str, Any] = {}
    exec(POLICY, space)
    step = space["make"]()["step"]
    t, rest = torch.tensor(seen["t"]).reshape(1, 1), torch.tensor(seen["prev_chunk_left_over"])
    share = step.wanted(*(torch.tensor([seen[name]]) for name in ("inference_delay", "execution_horizon")))
    x = torch.tensor(noise)
    for number in range(STEPS):
        tau = torch.tensor(number / STEPS)
        x = x.detach().requires_grad_()
        expected = step.denoised(x, tau, t)[0]
        (pulled,) = torch.autograd.grad(expected, x, ((rest - expected) * share).detach())
        left = (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)
        weight = torch.clamp((1 - tau) / (tau * left + 1e-6), max=LARGEST_WEIGHT)
        x = x + ((expected - x) / (1 - tau) + weight * pulled) / STEPS
    return x.detach().numpy()[0]
