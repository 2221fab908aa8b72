"""What every test may use: a complete tiny policy and the bundles that are made from it.

The bundles are made once in a session and must not be changed; copy one (``copied``) to damage it.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.bundle import Bundle, seal
from vlatool.runtime.engines.ort_cpu import OrtCpuSession

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
    from vlatool.sources._factory import call_factory

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


COLUMNS = (
    "device", "power_mode", "runtime", "model", "params_m", "gflops_or_gmacs", "input", "precision", "batch", "metric",
    "value", "macts_m", "n_layers", "device_class",
)  # fmt: skip
PUBLISHED = {
    "resnet18": (1.8, 11.7, 2.5, 21),
    "resnet50": (4.1, 25.6, 11.1, 54),
    "mobilenet_v2": (0.3, 3.5, 6.7, 53),
    "vit_small": (4.6, 22.0, 11.9, 74),
    "densenet121": (2.9, 8.0, 6.9, 121),
    "yolov8n": (4.4, 3.2, 12.0, 64),
}
"""Model -> 10^9 multiply-accumulates, 10^6 weights, 10^6 activations, layers."""
MEASURED_ON = (
    ("raspberry-pi-4", "cpu", "ncnn", "fp32", 0.02), ("raspberry-pi-5", "cpu", "onnxruntime", "fp32", 0.06),
    ("rk3588", "cpu", "ncnn", "fp32", 0.07), ("i7-1360P", "cpu", "openvino", "int8", 1.5),
    ("jetson-orin-nano-8gb", "gpu", "tensorrt", "fp16", 3.6), ("jetson-agx-orin-64gb", "gpu", "tensorrt", "fp16", 15.0),
    ("rtx-4060", "gpu", "tensorrt", "fp16", 21.0), ("hailo-8", "npu", "hailort", "int8", 7.0),
    ("hailo-8l", "npu", "hailort", "int8", 3.5), ("core-ultra-7-155H", "npu", "openvino-npu", "int8", 3.0),
)  # fmt: skip
"""Device, class, runtime, precision, and 10^12 operations that it does in a second."""


def published_rows() -> list[dict[str, str]]:
    """Sixty made-up latencies in the columns of the collection: compute and layers, within 4 % of noise."""
    random = np.random.default_rng(0)
    found = []
    for device, kind, runtime, precision, speed in MEASURED_ON:
        for model, (gmacs, params, activations, layers) in PUBLISHED.items():
            ms = (2 * gmacs / speed + 0.01 * layers) * random.uniform(0.96, 1.04)
            values = (device, "", runtime, model, params, gmacs, "224", precision, "1", "latency_ms", f"{ms:.4f}",
                      activations, layers, kind)  # fmt: skip
            found.append(dict(zip(COLUMNS, map(str, values), strict=True)))
    return found


def write_points(path: Path, rows: list[dict[str, str]]) -> Path:
    """Write published latencies as a CSV file."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.fixture(scope="session", autouse=True)
def _cache_of_the_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the tests away from the user's cache and measurements, and child processes too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VLATOOL_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("VLATOOL_CALIBRATIONS", str(tmp_path_factory.mktemp("calibrations")))
        patch.setenv("VLATOOL_TRUST", str(tmp_path_factory.mktemp("trust") / "trusted.json"))
        yield


@pytest.fixture(scope="session")
def policy_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the tiny policy; read only."""
    return write_policy(tmp_path_factory.mktemp("template") / "tiny")


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


@pytest.fixture
def policy_dir(policy_template: Path, tmp_path: Path) -> Path:
    """A folder of the tiny policy that the test may change."""
    return Path(shutil.copytree(policy_template, tmp_path / "tiny"))


@pytest.fixture(scope="session")
def source_bundle(policy_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The source bundle of the tiny policy; read only."""
    from vlatool.sources.torch_module import TorchModule
    from vlatool.stage import Context

    out = tmp_path_factory.mktemp("source") / "bundle"
    out.mkdir()
    return TorchModule(policy=policy_template).run(None, out, Context())


@pytest.fixture(scope="session")
def float_bundle(source_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy as exported, float32; read only."""
    from vlatool.export.onnx import ExportOnnx
    from vlatool.stage import Context

    out = tmp_path_factory.mktemp("float") / "bundle"
    out.mkdir()
    return ExportOnnx().run(source_bundle, out, Context())


@pytest.fixture(scope="session")
def int8_bundle(float_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy in static int8; read only."""
    from vlatool.quantize.static_int8 import StaticInt8
    from vlatool.stage import Context

    out = tmp_path_factory.mktemp("int8") / "bundle"
    out.mkdir()
    return StaticInt8().run(float_bundle, out, Context())


@pytest.fixture
def onnx_file(float_bundle: Bundle, tmp_path: Path) -> Path:
    """An ONNX file of the tiny policy that the test may change."""
    return Path(shutil.copyfile(float_bundle.path / "graphs/main.onnx", tmp_path / "tiny.onnx"))


@pytest.fixture
def observation() -> dict[str, Any]:
    """One observation that fits the tiny policy, without the batch axis."""
    recorded = observations(1, seed=3)
    return {name: recorded[name][0] for name in ("image", "proprio")} | {"instruction": "go to the red"}


@pytest.fixture
def published() -> list[dict[str, str]]:
    """Rows of published latencies that the test may change."""
    return published_rows()


@pytest.fixture
def points_at(tmp_path: Path) -> Callable[[list[dict[str, str]]], Path]:
    """A function that writes rows of published latencies to a CSV file."""
    return lambda rows: write_points(tmp_path / "points.csv", rows)


@pytest.fixture(scope="session")
def points_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixty published latencies, made up; read only."""
    return write_points(tmp_path_factory.mktemp("points") / "points.csv", published_rows())


@pytest.fixture
def points_file(points_template: Path, tmp_path: Path) -> Path:
    """Sixty published latencies that the test may change."""
    return Path(shutil.copyfile(points_template, tmp_path / "points.csv"))


@pytest.fixture
def wrong_engine(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A function that lets ONNX Runtime give so many times what the graph says, as a wrong kernel would."""
    real = OrtCpuSession.run

    def make(factor: float) -> None:
        def run(self: OrtCpuSession, feeds: Any) -> dict[str, Any]:
            by = np.float32(factor if self.optimized else 1)
            return {name: value * by for name, value in real(self, feeds).items()}

        monkeypatch.setattr(OrtCpuSession, "run", run)

    return make


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[Bundle], Bundle]:
    """A function that copies a bundle to a place where the test may damage it."""

    def copy(bundle: Bundle) -> Bundle:
        return Bundle(Path(shutil.copytree(bundle.path, tmp_path / "copied")), bundle.manifest)

    return copy


@pytest.fixture
def resealed() -> Callable[[Bundle], Bundle]:
    """A function that hashes the files of a bundle again, so that a damage is no longer seen as a changed file."""

    def again(bundle: Bundle) -> Bundle:
        return seal(bundle.path, bundle.manifest)

    return again
