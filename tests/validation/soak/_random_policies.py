"""Random small torch policies as a person would write them: a folder with policy.py, policy.yaml and recordings."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import yaml

RECORDED = 64
"""Observations for calibration, as many as a stage reads; with 8, those that come after leave the ranges by half."""
WORDS = ("go", "to", "the", "red", "blue", "ball", "box")
TEXTS = ("go to red ball", "blue box", "ball to the box", "go")
BODIES = {
    "mlp": ("nn.Sequential(nn.Linear(W, 2 * W), nn.GELU(), nn.Linear(2 * W, W))", "h + self.body(h)"),
    "norm": ("nn.Sequential(nn.LayerNorm(W), nn.Linear(W, W), nn.SiLU())", "h + self.body(h)"),
    "attention": (
        "nn.MultiheadAttention(W, 2, batch_first=True)", "h + self.body(h[:, None] * TOKENS, h[:, None] * TOKENS, "
        "h[:, None] * TOKENS, need_weights=False)[0].mean(1)",
    ),
    "gate": ("nn.Linear(W, 2 * W)", "nn.functional.glu(self.body(h), -1) + h"),
    "recurrent": ("nn.GRUCell(W, W)", "self.body(h, torch.tanh(h))"),
    "batchnorm": ("nn.Sequential(nn.Linear(W, W), nn.BatchNorm1d(W), nn.ReLU())", "h + self.body(h)"),
    "convolution": ("nn.Conv1d(1, 1, 3, padding=1)", "h + torch.relu(self.body(h[:, None])[:, 0])"),
}  # fmt: skip
"""Kind -> module, and what a turn computes of h, [1, W]."""
MAIN = """\
class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        W = {width}
{modules}
        self.body = {body}
        self.head = nn.Linear(W, {rows} * {size}{head_bias})
{more}

    def forward(self, {takes}):
        h = {sum}
        TOKENS = torch.ones(1, 3, {width}) * torch.arange(1, 4)[None, :, None] / 3
        for _ in range({turns}):
            h = {turn}
        action = self.head(h).reshape(1, {rows}, {size})
{returns}
"""


class RandomPolicy:
    """A policy that a seed decides.

    Args:
        seed: Of everything in it.
    """

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        choose = self.random.choice
        self.seed = seed
        self.width = choose([8, 16, 32, 64])
        self.rows, self.size = choose([1, 1, 4, 8]), choose([1, 2, 7])
        self.body = choose(sorted(BODIES))
        self.turns = choose([1, 1, 2, 5])
        self.inputs = self._inputs()
        self.keeps = self.random.random() < 0.3
        self.values = self.random.random() < 0.3
        self.flow = not self.keeps and not self.values and self.random.random() < 0.3
        self.bias = self.random.random() < 0.8

    @property
    def words(self) -> str:
        """What kind of policy it is."""
        told = [*(kind for _, kind, _ in self.inputs), f"{self.body} x{self.turns}", f"width {self.width}"]
        told += [name for name in ("keeps", "values", "flow") if getattr(self, name)]
        return ", ".join(told)

    def _inputs(self) -> list[tuple[str, str, tuple[int, ...]]]:
        kinds = self.random.sample(["state", "image", "sequence", "ids", "flag", "text"], self.random.randint(1, 3))
        side, width = self.random.choice([8, 12, 16]), self.random.choice([1, 3, 6, 10])
        shapes = {"state": (1, width), "image": (1, side, side, 3), "sequence": (1, self.random.choice([2, 5]), 4),
                  "ids": (1, 3), "flag": (1, 2), "text": (1, 4)}  # fmt: skip
        return [(f"in_{kind}", kind, shapes[kind]) for kind in kinds]

    def write(self, folder: Path) -> Path:
        """Write the policy into a new folder."""
        folder.mkdir(parents=True)
        (folder / "policy.py").write_text(self._code())
        (folder / "policy.yaml").write_text(yaml.safe_dump(self._description(), sort_keys=False))
        words = {"kind": "words", "pad": 0, "unknown": 1, "words": {word: 2 + at for at, word in enumerate(WORDS)}}
        (folder / "vocabulary.json").write_text(json.dumps(words))
        self.record(folder / "calibration.npz")
        return folder

    def record(self, path: Path, *more: dict[str, Any]) -> Path:
        """Write a recording for calibration, with further observations in it."""
        seen = [*self.observations(RECORDED, self.seed), *more]
        np.savez(path, **{name: np.array([each[name] for each in seen]) for name in seen[0]})
        return path

    def observations(self, count: int, seed: int) -> list[dict[str, Any]]:
        """Draw observations without a batch axis."""
        random = np.random.default_rng(seed)
        return [{name: _value(kind, shape[1:], random) for name, kind, shape in self.inputs} for _ in range(count)]

    def noise(self, seed: int) -> dict[str, Any] | None:
        """Draw the noise of an inference, None where the program draws none."""
        if not self.flow:
            return None
        return {"x": np.random.default_rng(seed).standard_normal((1, self.rows, self.size)).astype(np.float32)}

    def _description(self) -> dict[str, Any]:
        inputs: list[dict[str, Any]] = []
        for name, kind, shape in self.inputs:
            each: dict[str, Any] = {"name": name, "shape": list(shape), "dtype": _dtype(kind)}
            if kind == "text":
                each |= {"kind": "text", "tokenizer": "vocabulary.json", "max_tokens": 4}
            inputs.append(each)
        outputs = [{"name": "action", "shape": [1, self.rows, self.size]}]
        outputs += [{"name": "value", "shape": [1, 1]}] if self.values else []
        spec = {"inputs": inputs, "outputs": outputs, "control_hz": 10, "chunk": self.rows}
        told: dict[str, Any] = {"name": f"random-{self.seed}", "source": "policy.py:make", "spec": spec}
        names = {name: name for name, _, _ in self.inputs}
        if self.keeps:
            told["program"] = [{
                "graph": "main", "feeds": {**names, "memory": "memory"},
                "gives": {"action": "action", "kept": "memory"},
                "keep": {"memory": {"shape": [1, self.width], "dtype": "float32"}},
            }]  # fmt: skip
            told["program"][0]["gives"] |= {"value": "value"} if self.values else {}
        if self.flow:
            told["program"] = [
                {"graph": "encode", "feeds": names, "gives": {"context": "context"}},
                {"graph": "step", "feeds": {"context": "context", "x": "x", "time": "time"},
                 "gives": {"next": "action"}, "repeat": 3, "carry": {"action": "x"},
                 "schedule": {"time": [0.0, 0.25, 0.5]},
                 "noise": {"x": {"shape": [1, self.rows, self.size], "distribution": "normal"}}},
            ]  # fmt: skip
        return told

    def _code(self) -> str:
        modules, terms = zip(*(_encoder(name, kind, shape) for name, kind, shape in self.inputs), strict=True)
        body, turn = BODIES[self.body]
        takes = [name for name, _, _ in self.inputs] + (["memory"] if self.keeps else [])
        returns = ["action"] + (["torch.tanh(h)"] if self.keeps else []) + (["self.value(h)"] if self.values else [])
        given = f"        return {', '.join(returns)}"
        total = " + ".join([*terms, *(["0.5 * memory"] if self.keeps else [])])
        main = MAIN.format(
            width=self.width, modules="\n".join(f"        {line}" for line in modules), body=body, rows=self.rows,
            size=self.size, head_bias="" if self.bias else ", bias=False", takes=", ".join(takes), sum=total,
            more="        self.value = nn.Linear(W, 1)" if self.values else "", turns=self.turns, turn=turn,
            returns="        return h" if self.flow else given,
        )  # fmt: skip
        return f"import torch\nfrom torch import nn\n\n\n{main}\n{self._rest()}"

    def _rest(self) -> str:
        count = self.rows * self.size
        seeded = f"    torch.manual_seed({self.seed})\n"
        if not self.flow:
            return f"\ndef make():\n{seeded}    return Policy()\n"
        return f"""
class Step(nn.Module):
    def __init__(self):
        super().__init__()
        self.mix = nn.Linear({self.width} + {count} + 1, {count})

    def forward(self, context, x, time):
        together = torch.cat([context, x.flatten(1), time[None]], 1)
        return x + 0.3 * torch.tanh(self.mix(together)).reshape(x.shape)


def make():
{seeded}    return {{"encode": Policy(), "step": Step()}}
"""


def _encoder(name: str, kind: str, shape: tuple[int, ...]) -> tuple[str, str]:
    """Return the modules of an input, and what they give of it: [1, W]."""
    if kind == "image":
        layers = "nn.Conv2d(3, 8, 3, 2, 1), nn.BatchNorm2d(8), nn.ReLU(), nn.Conv2d(8, W, 3, 2, 1)"
        module = f"self.{name} = nn.Sequential({layers})"
        return module, f"self.{name}({name}.permute(0, 3, 1, 2).float() / 127.5 - 1).mean((2, 3))"
    if kind == "sequence":
        return f"self.{name} = nn.GRU(4, W, batch_first=True)", f"self.{name}({name})[0][:, -1]"
    if kind in ("ids", "text"):
        return f"self.{name} = nn.Embedding(10, W)", f"self.{name}({name}).mean(1)"
    cast = ".float()" if kind == "flag" else ""
    return f"self.{name} = nn.Linear({shape[1]}, W)", f"self.{name}({name}{cast})"


def _dtype(kind: str) -> str:
    return {"image": "uint8", "ids": "int32", "text": "int64", "flag": "bool"}.get(kind, "float32")


def _value(kind: str, shape: tuple[int, ...], random: np.random.Generator) -> Any:
    if kind == "text":
        return str(random.choice(TEXTS))
    if kind == "image":
        return random.integers(0, 256, shape, np.uint8)
    if kind == "ids":
        return random.integers(0, 10, shape).astype(np.int32)
    if kind == "flag":
        return random.integers(0, 2, shape).astype(bool)
    return random.standard_normal(shape).astype(np.float32)
