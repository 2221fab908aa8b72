"""The shapes that policies of others have, small and with torch alone: memory, denoising, tokens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from _full import small_or_full

from vlatool.bundle.bundle import Bundle
from vlatool.export.onnx import ExportOnnx
from vlatool.quantize.float8 import Float8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.quantize.weight_only import WeightOnly
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context

GRU = """\
import torch
from torch import nn


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        self.camera = nn.Sequential(nn.Conv2d(3, 8, 3, stride=2), nn.BatchNorm2d(8), nn.ReLU(), nn.AdaptiveAvgPool2d(1))
        self.gru = nn.GRU(8 + 2, 16)
        self.head = nn.Linear(16, 2)

    def forward(self, image, joints, memory):
        seen = self.camera(image.permute(0, 3, 1, 2).float() / 255).flatten(1)
        out, memory = self.gru(torch.cat([seen, joints], 1).unsqueeze(0), memory)
        return self.head(out[0]).unsqueeze(1), memory


def make():
    torch.manual_seed(0)
    return Network()
"""
GRU_YAML = """\
name: recurrent
source: policy.py:make
spec:
  inputs: [{name: image, shape: [1, 16, 16, 3], dtype: uint8}, {name: joints, shape: [1, 2]}]
  outputs: [{name: action, shape: [1, 1, 2]}]
  control_hz: 10
program:
  - graph: main
    feeds: {image: image, joints: joints, memory: memory}
    gives: {action: action, next_memory: memory}
    keep: {memory: {shape: [1, 1, 16], dtype: float32}}
"""
DDIM = """\
import torch
from torch import nn


class Encode(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(4, 8)

    def forward(self, state):
        return self.linear(state).flatten(1)


class Denoise(nn.Module):
    def __init__(self):
        super().__init__()
        self.down, self.up = nn.Conv1d(2, 16, 3, padding=1), nn.Conv1d(16, 2, 3, padding=1)
        self.condition = nn.Linear(16, 16)
        self.register_buffer("alphas", torch.linspace(0.99, 0.1, 11))

    def forward(self, sample, time, condition):
        here = time.long()
        noise = self.down(sample.transpose(1, 2)) + self.condition(condition)[:, :, None]
        noise = self.up(torch.relu(noise)).transpose(1, 2)
        now, then = self.alphas[here], self.alphas[here - 2]
        clean = ((sample - (1 - now).sqrt() * noise) / now.sqrt()).clamp(-1, 1)
        sample = then.sqrt() * clean + (1 - then).sqrt() * noise
        return sample, sample[:, 1:5]


def make():
    torch.manual_seed(0)
    return {"encode": Encode(), "denoise": Denoise()}
"""
DDIM_YAML = """\
name: diffusion
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 2, 4]}]
  outputs: [{name: action, shape: [1, 4, 2]}]
  control_hz: 10
  chunk: 4
program:
  - {graph: encode, feeds: {state: state}, gives: {condition: condition}}
  - graph: denoise
    feeds: {sample: sample, time: time, condition: condition}
    gives: {next_sample: next_sample, action: action}
    repeat: 4
    carry: {next_sample: sample}
    schedule: {time: [10, 8, 6, 4]}
    noise: {sample: {shape: [1, 8, 2], distribution: normal}}
"""
TOKENS = """\
import torch
from torch import nn


class Prefill(nn.Module):
    def __init__(self, embed, key):
        super().__init__()
        self.embed, self.key, self.head = embed, key, nn.Linear(16, 40)

    def forward(self, ids):
        seen = self.embed(ids)
        keys = nn.functional.pad(self.key(seen), (0, 0, 0, 3))
        return keys, nn.functional.pad(self.head(seen.mean(1))[:, None], (0, 0, 0, 2))


class Decode(nn.Module):
    def __init__(self, embed, key):
        super().__init__()
        self.embed, self.key, self.query, self.head = embed, key, nn.Linear(16, 16), nn.Linear(16, 40)

    def forward(self, number, keys, logits):
        number = number.long()
        seen = self.embed(logits.index_select(1, number - 1).argmax(-1))
        slots = torch.arange(8)[None, :, None]
        keys = torch.where(slots == 4 + number, self.key(seen), keys)
        weights = (self.query(seen) @ keys.transpose(1, 2)).masked_fill(slots.transpose(1, 2) > 4 + number, -1e9)
        row = self.head(torch.softmax(weights, -1) @ keys)
        return keys, torch.where(torch.arange(3)[None, :, None] == number, row, logits)


def make():
    torch.manual_seed(0)
    embed, key = nn.Embedding(40, 16), nn.Linear(16, 16)
    return {"prefill": Prefill(embed, key), "decode": Decode(embed, key)}
"""
TOKENS_YAML = """\
name: tokens
source: policy.py:make
spec:
  inputs: [{name: ids, shape: [1, 5], dtype: int64}]
  outputs: [{name: action, kind: discrete, shape: [1, 3, 40]}]
  control_hz: 10
  chunk: 3
program:
  - {graph: prefill, feeds: {ids: ids}, gives: {keys: keys, action: action}}
  - graph: decode
    feeds: {number: number, keys: keys, logits: action}
    gives: {next_keys: next_keys, next_logits: next_logits}
    repeat: 2
    carry: {next_keys: keys, next_logits: action}
    schedule: {number: [1, 2]}
"""


def exported(folder: Path, code: str, description: str, **recorded: np.ndarray) -> tuple[Bundle, Any]:
    """Write a policy, export it, and return the bundle with what its make() gives."""
    folder.mkdir()
    (folder / "policy.py").write_text(code)
    (folder / "policy.yaml").write_text(description)
    np.savez(folder / "calibration.npz", **recorded)
    source, out = folder / "source", folder / "float32"
    source.mkdir()
    out.mkdir()
    bundle = ExportOnnx().run(TorchModule(policy=folder).run(None, source, Context()).bundle, out, Context()).bundle
    space: dict[str, Any] = {}
    exec(code, space)
    made = space["make"]()
    for module in made.values() if isinstance(made, dict) else [made]:
        module.eval()
    return bundle, made


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_a_recurrent_policy_gives_what_torch_gives_over_an_episode(tmp_path, engine):
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (6, 16, 16, 3), np.uint8)
    joints = random.normal(size=(6, 2)).astype(np.float32)
    bundle, network = exported(tmp_path / "policy", GRU, GRU_YAML, image=image, joints=joints)
    policy = load(bundle.path, engine=engine)
    for _ in range(2):
        memory = torch.zeros(1, 1, 16)
        policy.reset()
        for row in range(6):
            with torch.no_grad():
                wanted, memory = network(
                    torch.tensor(image[row : row + 1]), torch.tensor(joints[row : row + 1]), memory
                )
            got = policy.infer({"image": image[row], "joints": joints[row]}).chunk
            np.testing.assert_allclose(got, wanted[0].numpy(), rtol=1e-4, atol=1e-5)


def test_a_diffusion_policy_gives_what_torch_gives_from_the_same_noise(tmp_path):
    random = np.random.default_rng(0)
    state, noise = random.normal(size=(4, 2, 4)).astype(np.float32), random.normal(size=(1, 8, 2)).astype(np.float32)
    bundle, parts = exported(tmp_path / "policy", DDIM, DDIM_YAML, state=state)
    with torch.no_grad():
        condition, sample = parts["encode"](torch.tensor(state[:1])), torch.tensor(noise)
        for time in (10.0, 8.0, 6.0, 4.0):
            sample, wanted = parts["denoise"](sample, torch.tensor([time]), condition)
    got = load(bundle.path).infer({"state": state[0]}, noise={"sample": noise}).chunk
    np.testing.assert_allclose(got, wanted[0].numpy(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("method", [StaticInt8, *small_or_full([], [Float8])])
def test_a_diffusion_policy_is_no_other_one_in_8_bits(tmp_path, method):
    """A Relu stands before a convolution: in float8, ONNX Runtime would leave it out."""
    random = np.random.default_rng(0)
    state, noise = random.normal(size=(8, 2, 4)).astype(np.float32), random.normal(size=(1, 8, 2)).astype(np.float32)
    bundle, _ = exported(tmp_path / "policy", DDIM, DDIM_YAML, state=state)
    (tmp_path / "eighth").mkdir()
    made = method().run(bundle, tmp_path / "eighth", Context()).bundle
    assert made.manifest.findings == ()
    got, wanted = (
        np.array([load(each.path).infer({"state": row}, noise={"sample": noise}).chunk for row in state])
        for each in (made, bundle)
    )
    assert relative_error(got, wanted) < 0.1


def test_a_policy_that_writes_tokens_gives_those_of_torch_also_in_8_bits(tmp_path):
    ids = np.random.default_rng(0).integers(0, 40, (16, 5))
    bundle, parts = exported(tmp_path / "policy", TOKENS, TOKENS_YAML, ids=ids)
    wanted = []
    for row in ids:
        with torch.no_grad():
            keys, logits = parts["prefill"](torch.tensor(row[None]))
            for number in (1.0, 2.0):
                keys, logits = parts["decode"](torch.tensor([number]), keys, logits)
        wanted.append(logits[0].argmax(-1).numpy())
    policy = load(bundle.path)
    assert np.array_equal([policy.infer({"ids": row}).chunk for row in ids], wanted)
    assert policy.infer({"ids": ids[0]}).labels == tuple(str(token) for token in wanted[0])
    (tmp_path / "int8").mkdir()
    WeightOnly(bits=8, block=32).run(bundle, tmp_path / "int8", Context())
    smaller = load(tmp_path / "int8")
    assert np.mean(np.array([smaller.infer({"ids": row}).chunk for row in ids]) == wanted) > 0.9
