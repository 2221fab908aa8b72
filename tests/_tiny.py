"""A complete policy that is as small as a policy can be, for tests and for what attacks bundles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

POLICY_YAML = """\
schema: 1
name: tiny
version: 1.2.0
description: A policy that is as small as a policy can be.
license: MIT
source: policy.py:make
arguments: {layers: 1}
spec:
  inputs:
    - {name: image, shape: [1, 8, 8, 3], dtype: uint8, unit: rgb}
    - {name: proprio, shape: [1, 3], unit: [m, m, rad], normalisation: mean_std, statistics: statistics.json#proprio}
    - {name: instruction, kind: text, shape: [1, 4], dtype: int64, tokenizer: vocabulary.json, max_tokens: 4}
  outputs:
    - {name: action, shape: [1, 4, 2], unit: [m, m], labels: [dx, dy], mode: delta,
       normalisation: mean_std, statistics: statistics.json#action}
  control_hz: 10
  chunk: 4
  execute: 2
environment:
  make: environment.py:make
  tasks: [reach, push]
parts:
  vision: ["vision", "vision.*"]
  head: ["head"]
"""

POLICY_PY = '''\
"""Image, proprioception and instruction to a chunk of actions, through one transformer block."""

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import nn

WIDTH = 16


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.norm = nn.LayerNorm(WIDTH)
        self.query = nn.Linear(WIDTH, WIDTH)
        self.key = nn.Linear(WIDTH, WIDTH)
        self.value = nn.Linear(WIDTH, WIDTH)
        self.mlp = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 32), nn.GELU(), nn.Linear(32, WIDTH))

    def forward(self, tokens):
        normed = self.norm(tokens)
        scores = self.query(normed) @ self.key(normed).transpose(-2, -1) * WIDTH**-0.5
        tokens = tokens + torch.softmax(scores, -1) @ self.value(normed)
        return tokens + self.mlp(tokens)


class Policy(nn.Module):
    def __init__(self, layers):
        super().__init__()
        self.vision = nn.Conv2d(3, WIDTH, kernel_size=4, stride=4)
        self.state = nn.Linear(3, WIDTH)
        self.words = nn.Embedding(9, WIDTH)
        self.blocks = nn.Sequential(*(Block() for _ in range(layers)))
        self.head = nn.Linear(WIDTH, 8)

    def forward(self, image, proprio, instruction):
        pixels = image.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        patches = self.vision(pixels).flatten(2).transpose(1, 2)
        tokens = torch.cat([patches, self.state(proprio)[:, None], self.words(instruction)], 1)
        return self.head(self.blocks(tokens).mean(1)).reshape(1, 4, 2)


def make(layers=1):
    policy = Policy(layers)
    policy.load_state_dict(load_file(str(Path(__file__).with_name("weights.safetensors"))))
    return policy
'''

ENVIRONMENT_PY = '''\
"""A world with gymnasium's interface, without gymnasium: deterministic in task, seed and actions."""

import functools
import importlib.util
import json
from pathlib import Path

import numpy as np

STEPS = 5
HERE = Path(__file__).parent


@functools.cache
def teacher():
    """The network that knows the right action, and the statistics and words that it needs."""
    spec = importlib.util.spec_from_file_location("teacher", HERE / "policy.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    files = [json.loads((HERE / name).read_text()) for name in ("statistics.json", "vocabulary.json")]
    return module.make().eval(), *files


def expert(observation):
    """The right chunk (4, 2) in metres: that of the teacher."""
    import torch

    network, statistics, vocabulary = teacher()
    proprio, action = ({key: np.float32(value) for key, value in statistics[name].items()} for name in statistics)
    ids = [vocabulary["words"].get(word, 1) for word in str(observation["instruction"]).split()][:4]
    words = torch.tensor([ids + [0] * (4 - len(ids))])
    state = torch.from_numpy((observation["proprio"] - proprio["mean"]) / proprio["std"])[None]
    with torch.no_grad():
        chunk = network(torch.from_numpy(observation["image"].copy())[None], state, words)[0].numpy()
    return chunk * action["std"] + action["mean"]


class Environment:
    """Ends after five steps; who begins as the expert does succeeds at every seed that 5 does not divide.

    With a wrong instruction, anybody succeeds at every third.
    """

    def __init__(self, task, instruction):
        self.task = task
        self.instruction = instruction
        self.closed = False

    def _observation(self):
        return {
            "image": self.random.integers(0, 256, (8, 8, 3), np.uint8),
            "proprio": self.position.copy(),
            "instruction": "go to the ball" if self.instruction == "right" else "",
        }

    def reset(self, *, seed=None):
        self.seed, self.steps = seed, 0
        self.random = np.random.default_rng(seed)
        self.position = np.zeros(3, np.float32)
        self.off = 0.0
        first = self._observation()
        self.right = expert(first)
        return first, {}

    def step(self, action):
        if np.shape(action) != (2,):
            raise ValueError(f"the action has the shape {np.shape(action)}")
        if self.steps < 2:
            self.off += float(np.abs(action - self.right[self.steps]).max())
        self.steps += 1
        self.position[:2] += np.clip(action, -0.1, 0.1)
        done = self.steps == STEPS
        good = self.off < 0.04 and self.seed % 5 != 0 if self.instruction == "right" else self.seed % 3 == 0
        return self._observation(), float(done and good), done, False, {"success": done and good}

    def close(self):
        self.closed = True


def make(task="reach", instruction="right"):
    return Environment(task, instruction)
'''

VOCABULARY = {
    "kind": "words",
    "pad": 0,
    "unknown": 1,
    "words": {"go": 2, "to": 3, "the": 4, "red": 5, "blue": 6, "ball": 7, "box": 8},
}
STATISTICS = {
    "proprio": {"mean": [0.1, -0.2, 0.5], "std": [0.5, 0.25, 2.0]},
    "action": {"mean": [0.01, -0.02], "std": [0.05, 0.1]},
}
INSTRUCTIONS = ("go to the ball", "go to the box", "red ball", "blue box")


def observations(count: int, seed: int) -> dict[str, Any]:
    """Recorded samples of the tiny policy: inputs, expert actions in metres, episodes of four samples."""
    random = np.random.default_rng(seed)
    return {
        "image": random.integers(0, 256, (count, 8, 8, 3), np.uint8),
        "proprio": random.normal([0.1, -0.2, 0.5], [0.5, 0.25, 2.0], (count, 3)).astype(np.float32),
        "instruction": np.array([INSTRUCTIONS[index % len(INSTRUCTIONS)] for index in range(count)]),
        "action": random.normal(0, 0.05, (count, 4, 2)).astype(np.float32),
        "episode": np.arange(count) // 4,
    }


def with_expert(recorded: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Give recorded samples the actions of the expert in a policy's folder, whose hand shakes a little."""
    from vlatool.module.factory import call_factory

    seen = [{name: recorded[name][index] for name in ("image", "proprio", "instruction")}
            for index in range(len(recorded["image"]))]  # fmt: skip
    right = np.stack([call_factory("environment.py:expert", folder, {"observation": each}) for each in seen])
    shaken = right + np.random.default_rng(len(seen)).normal(0, 0.01, right.shape)
    return recorded | {"action": shaken.astype(np.float32)}


def write_weights(path: Path) -> None:
    """Seeded weights of the tiny policy, of the size that a trained one has."""
    import torch
    from safetensors.torch import save_file

    generator = torch.Generator().manual_seed(0)
    shapes = {
        "vision.weight": (16, 3, 4, 4),
        "vision.bias": (16,),
        "state.weight": (16, 3),
        "state.bias": (16,),
        "words.weight": (9, 16),
        "head.weight": (8, 16),
        "head.bias": (8,),
    }
    for name, shape in (("query", (16, 16)), ("key", (16, 16)), ("value", (16, 16))):
        shapes |= {f"blocks.0.{name}.weight": shape, f"blocks.0.{name}.bias": shape[:1]}
    for name, shape in (("mlp.1", (32, 16)), ("mlp.3", (16, 32))):
        shapes |= {f"blocks.0.{name}.weight": shape, f"blocks.0.{name}.bias": shape[:1]}
    weights = {
        name: torch.randn(shape, generator=generator) * (0.5 if len(shape) == 1 else shape[-1] ** -0.5)
        for name, shape in shapes.items()
    }
    for norm in ("blocks.0.norm", "blocks.0.mlp.0"):
        weights |= {f"{norm}.weight": torch.ones(16), f"{norm}.bias": torch.zeros(16)}
    save_file(weights, str(path))


def deepen(folder: Path) -> None:
    """Give the tiny policy in a folder three blocks, each of larger weights than the one before."""
    from safetensors.torch import load_file, save_file

    description, weights = folder / "policy.yaml", folder / "weights.safetensors"
    description.write_text(description.read_text().replace("layers: 1", "layers: 3"))
    stored = load_file(weights)
    more = {
        name.replace("blocks.0", f"blocks.{number}"): value * (1 + number)
        for name, value in stored.items()
        for number in (1, 2)
    }
    save_file({**more, **stored}, weights)


def write_policy(folder: Path) -> Path:
    """Write the tiny policy into a new folder."""
    folder.mkdir()
    (folder / "policy.yaml").write_text(POLICY_YAML)
    (folder / "policy.py").write_text(POLICY_PY)
    (folder / "environment.py").write_text(ENVIRONMENT_PY)
    (folder / "vocabulary.json").write_text(json.dumps(VOCABULARY))
    (folder / "statistics.json").write_text(json.dumps(STATISTICS))
    write_weights(folder / "weights.safetensors")
    np.savez(folder / "calibration.npz", **with_expert(observations(24, seed=1), folder))
    np.savez(folder / "evaluation.npz", **with_expert(observations(16, seed=2), folder))
    return folder
