"""Policies that keep values from step to step, of many kinds, through the stages: right, refused, or wrong.

    python tests/validation/soak/kept_values.py                    # all of them, 15 s of a core for each
    python tests/validation/soak/kept_values.py lstm-2 ring        # some

Each is exported, pruned, trained for 20 updates and quantized to int8, and every bundle is run for 100 steps in two
episodes beside the policy's own module, whose state this file carries. Wrong is an answer of an export that differs by
more than 1e-4 (relative L2 over all steps), one of int8 by more than 0.25, or an error that is not one of vlatool's.
Exit code 1 when one was wrong.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

STEPS, LENGTH = 100, 50
"""Of a run, and of an episode."""
FLOAT, INT8 = 1e-4, 0.25
"""Relative L2 that the actions of a bundle may differ from its module's."""
HEAD = """\
import dataclasses
import torch
from torch import nn


class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.i, self.h, self.o = nn.Linear(8, 32), nn.Linear(32, 32), nn.Linear(32, 2)
LAYERS
    def forward(self, target, *kept):
        x = torch.relu(self.i(target))
FORWARD

    def act(self, y):
        return self.o(torch.relu(self.h(y)))[:, None]


def make():
    torch.manual_seed(0)
    return Policy().eval()
"""
TRAINING = {"steps": 20, "batch": 96, "episodes": 0, "student_episodes": 0, "threads": 1, "precision": "float32"}


@dataclass(frozen=True)
class Kind:
    """A policy.

    Args:
        keep: Name -> shape and dtype of what its program keeps.
        layers, forward: Lines of its module: what it has besides three linear layers, and what it does with ``x``.
        refused: Whether no export of it can be right.
    """

    keep: Mapping[str, tuple[list[int], str]]
    layers: str
    forward: str
    refused: bool = False


def _kind(keep: str, layers: str, forward: str, *, refused: bool = False) -> Kind:
    """Read ``name 1x32 float32; ...``."""
    values = {}
    for each in filter(None, keep.split("; ")):
        name, shape, dtype = each.split()
        values[name] = ([int(size) for size in shape.split("x")] if shape != "-" else [], dtype)
    return Kind(values, layers, forward, refused)


CELL, START = "self.m = nn.GRUCell(32, 32)", "self.start = nn.Parameter(torch.randn(1, 32))"
FLAGGED = "self.act(h), h, torch.ones_like(kept[1])"
ATTENDS = """\
k = torch.cat([kept[0][:, 1:], self.k(x)[:, None]], 1)
v = torch.cat([kept[1][:, 1:], self.v(x)[:, None]], 1)
n = (kept[2] + 1).clamp(max=6)
s = (self.q(x)[:, None] @ k.transpose(1, 2)) / 32 ** 0.5
y = s.masked_fill((torch.arange(6) < 6 - n)[:, None], -1e9).softmax(-1) @ v
return self.act(x + y[:, 0]), k, v, n"""
NORMALISES = """\
n = kept[2] + 1
d = target - kept[0]
mean = kept[0] + d / n
square = kept[1] + d * (target - mean)
y = (target - mean) / (square / n + 1).sqrt()
return self.act(torch.relu(self.i(y))), mean, square, n"""
KINDS = {
    "lstm-2": _kind(
        "h 2x1x16 float32; c 2x1x16 float32", "self.m, self.p = nn.LSTM(32, 16, num_layers=2), nn.Linear(16, 32)",
        "y, (h, c) = self.m(x[None], (kept[0], kept[1]))\nreturn self.act(self.p(y[0])), h, c"),
    "lstm-cells": _kind(
        "h 1x32 float32; c 1x32 float32", "self.m = nn.LSTMCell(32, 32)",
        "h, c = self.m(x, (kept[0], kept[1]))\nreturn self.act(h), h, c"),
    "gru-cell-in-a-loop": _kind(
        "h 1x32 float32", CELL, "h = kept[0]\nfor _ in range(3):\n    h = self.m(x, h)\nreturn self.act(h), h"),
    "gru-batch-second": _kind(
        "h 2x1x32 float32", "self.m = nn.GRU(32, 32, num_layers=2)",
        "y, h = self.m(x[None], kept[0])\nreturn self.act(y[0]), h"),
    "rnn": _kind(
        "h 1x1x32 float32", "self.m = nn.RNN(32, 32, batch_first=True)",
        "y, h = self.m(x[:, None], kept[0])\nreturn self.act(y[:, 0]), h"),
    "window": _kind(
        "w 1x4x32 float32", "self.p = nn.Linear(128, 32)",
        "w = torch.cat([kept[0][:, 1:], x[:, None]], 1)\nreturn self.act(self.p(w.flatten(1))), w"),
    "ring": _kind(
        "w 1x4x32 float32; n 1 int64", "self.p = nn.Linear(128, 32)",
        "own = torch.nn.functional.one_hot(kept[1] % 4, 4)[..., None].to(x)\n"
        "w = kept[0] * (1 - own) + own * x[:, None]\nreturn self.act(self.p(w.flatten(1))), w, kept[1] + 1"),
    "ring-scatter": _kind(
        "w 1x4x32 float32; n 1x1 int64", "self.p = nn.Linear(128, 32)",
        "place = (kept[1] % 4)[..., None].expand(-1, 1, 32)\n"
        "w = kept[0].scatter(1, place, x[:, None])\nreturn self.act(self.p(w.flatten(1))), w, kept[1] + 1"),
    "ring-indexed": _kind(
        "w 1x4x32 float32; n 1 int64", "self.p = nn.Linear(128, 32)",
        "w = kept[0].clone()\nw[torch.arange(len(x)), kept[1] % 4] = x\n"
        "return self.act(self.p(w.flatten(1))), w, kept[1] + 1"),
    "exponential-filter": _kind(
        "f 1x32 float32", "self.a = nn.Parameter(torch.tensor(0.5))",
        "f = kept[0] + torch.sigmoid(self.a) * (x - kept[0])\nreturn self.act(f), f"),
    "counter": _kind(
        "n 1 int64", "self.e = nn.Embedding(200, 32)", "return self.act(x + self.e(kept[0])), kept[0] + 1"),
    "counter-without-axes": _kind(
        "n - int64", "self.e = nn.Embedding(200, 32)", "return self.act(x + self.e(kept[0])), kept[0] + 1",
        refused=True),
    "kv-cache": _kind(
        "k 1x6x32 float32; v 1x6x32 float32; n 1x1 int64",
        "self.q, self.k, self.v = (nn.Linear(32, 32) for _ in range(3))", ATTENDS),
    "running-normaliser": _kind("mean 1x8 float32; square 1x8 float32; n 1x1 float32", "", NORMALISES),
    "flag": _kind(
        "h 1x32 float32; begun 1x1 float32", f"{CELL}; {START}",
        f"h = self.m(x, torch.where(kept[1] > 0, kept[0], self.start))\nreturn {FLAGGED}"),
    "bool-flag": _kind(
        "h 1x32 float32; begun 1x1 bool", f"{CELL}; {START}",
        f"h = self.m(x, torch.where(kept[1], kept[0], self.start))\nreturn {FLAGGED}"),
    "float16": _kind("h 1x32 float16", CELL, "h = self.m(x, kept[0].float())\nreturn self.act(h), h.half()"),
    "bfloat16": _kind("h 1x32 bfloat16", CELL, "h = self.m(x, kept[0].float())\nreturn self.act(h), h.bfloat16()"),
    "float64": _kind("f 1x32 float64", "", "f = kept[0] * 0.9 + x.double() * 0.1\nreturn self.act(f.float()), f"),
    "int32-accumulator": _kind(
        "s 1x8 int32", "self.p = nn.Linear(8, 32)",
        "s = kept[0] + (target * 64).round().to(torch.int32)\nreturn self.act(x + self.p(s.float() / 640)), s"),
    "no-axis-for-a-batch": _kind("f 32 float32", "", "f = kept[0] * 0.5 + x[0]\nreturn self.act(f[None]), f"),
    "grows": _kind(
        "w 1x1x32 float32", "", "w = torch.cat([kept[0], x[:, None]], 1)\nreturn self.act(w.mean(1)), w", refused=True),
    "attribute": _kind(
        "", "self.s = torch.zeros(1, 32)", "self.s = self.s * 0.5 + x\nreturn self.act(self.s)", refused=True),
    "buffer": _kind(
        "", "self.register_buffer('s', torch.zeros(1, 32))", "self.s.mul_(0.5).add_(x)\nreturn self.act(self.s)",
        refused=True),
    "dict": _kind(
        "", "self.s = {'h': torch.zeros(1, 32)}", "self.s['h'] = self.s['h'] * 0.5 + x\nreturn self.act(self.s['h'])",
        refused=True),
    "list": _kind("", "self.s = []", "self.s = [*self.s, x][-4:]\nreturn self.act(sum(self.s))", refused=True),
    "number": _kind("", "self.s = 0", "self.s += 1\nreturn self.act(x * self.s)", refused=True),
    "dataclass": _kind(
        "", "self.s = dataclasses.make_dataclass('S', ['h'])(torch.zeros(1, 32))",
        "self.s.h = self.s.h * 0.5 + x\nreturn self.act(self.s.h)", refused=True),
}  # fmt: skip


def write_policy(folder: Path, kind: Kind) -> None:
    """Write a policy and four recorded episodes."""
    folder.mkdir(parents=True)
    lines = {"LAYERS": kind.layers, "FORWARD": kind.forward}
    code = HEAD
    for name, text in lines.items():
        code = code.replace(name, "\n".join(f"        {line}" for line in text.split("\n")))
    (folder / "policy.py").write_text(code)
    keep = {name: {"shape": shape, "dtype": dtype} for name, (shape, dtype) in kind.keep.items()}
    step = {"graph": "main", "feeds": {"target": "target", **{f"kept_{name}": name for name in keep}},
            "gives": {"action": "action", **{f"next_{name}": name for name in keep}}, "keep": keep}  # fmt: skip
    form = {"dtype": "float32", "unit": "m"}
    action = {"name": "action", "shape": [1, 1, 2], **form, "labels": ["x", "y"], "mode": "delta"}
    target = {"name": "target", "shape": [1, 8], **form}
    spec = {"inputs": [target], "outputs": [action], "control_hz": 10, "chunk": 1}
    about = {"schema": 1, "name": folder.name, "version": "1.0.0", "source": "policy.py:make", "spec": spec,
             "calibration": "calibration.npz", **({"program": [step]} if keep else {})}  # fmt: skip
    (folder / "policy.yaml").write_text(yaml.safe_dump(about, sort_keys=False))
    rows = observations(8, 0)
    episode = np.arange(len(rows)) // LENGTH
    np.savez(folder / "calibration.npz", target=rows, episode=episode, action=rows[:, :2])


def observations(episodes: int, seed: int) -> np.ndarray:
    """Smooth targets: (episodes x LENGTH, 8) float32."""
    random = np.random.default_rng(seed)
    steps = random.normal(0, 0.3, (episodes, LENGTH, 8)).cumsum(1)
    return np.clip(steps, -2, 2).reshape(-1, 8).astype(np.float32)


def by_hand(module: Any, kind: Kind, rows: np.ndarray) -> np.ndarray:
    """Run a module along the episodes; what it keeps is carried here: (N, 2)."""
    import torch

    given, kept = [], list[Any]()
    with torch.no_grad():
        for number, row in enumerate(rows):
            if number % LENGTH == 0:
                kept = [torch.zeros(shape, dtype=getattr(torch, dtype)) for shape, dtype in kind.keep.values()]
            given_now = module(torch.from_numpy(row[None]), *kept)
            action, *kept = given_now if isinstance(given_now, tuple) else (given_now,)
            given.append(action[0, 0].numpy())
    return np.stack(given)


def by_bundle(path: Path, rows: np.ndarray) -> np.ndarray:
    """Run a bundle along the episodes: (N, 2)."""
    import vlatool

    policy, given = vlatool.load(path), []
    for number, row in enumerate(rows):
        if number % LENGTH == 0:
            policy.reset()
        given.append(policy.infer({"target": row}).chunk[0])
    return np.stack(given)


def tried(name: str, place: Path) -> Iterator[tuple[str, str, str]]:
    """Yield stage, verdict (right, refused, wrong) and the distance or the reason, until one stage cannot go on."""
    from vlatool.module.torch_policy import load_modules
    from vlatool.sources.torch_module import TorchModule
    from vlatool.stage.base import Context
    from vlatool.stage.build import build_stage
    from vlatool.stage.run import run_transform
    from vlatool.user_code import trust

    kind, folder, rows = KINDS[name], place / name, observations(STEPS // LENGTH, 1)
    write_policy(folder, kind)
    trust.allow(folder)

    def done(stage: str, source: Any, options: Mapping[str, Any], out: str) -> Any:
        made = TorchModule(policy=folder) if not stage else build_stage(stage, dict(options))
        return run_transform(made, source, place / f"{name}-{out}", Context()).bundle

    def far(bundle: Any, module: Any) -> float:
        wanted = by_hand(module, kind, rows)
        return float(np.linalg.norm(by_bundle(bundle.path, rows) - wanted) / np.linalg.norm(wanted))

    made: dict[str, Any] = {}
    plan = [
        ("export", "source", "export.onnx", {}, FLOAT),
        ("int8", "export", "quantize.static_int8", {}, INT8),
        ("pruned", "source", "prune.structured", {"ratio": 0.15, "multiple": 1}, None),
        ("pruned export", "pruned", "export.onnx", {}, FLOAT),
        ("trained", "pruned", "distill.policy", TRAINING, None),
        ("trained export", "trained", "export.onnx", {}, FLOAT),
        ("qat", "source", "quantize.qat", TRAINING, None),
        ("qat export", "qat", "export.onnx", {}, FLOAT),
        ("qat int8", "qat export", "quantize.static_int8", {}, INT8),
    ]
    modules: dict[str, Any] = {}
    for title, start, stage, options, limit in [("source", None, "", {}, None), *plan]:
        if start is not None and start not in made:
            continue
        verdict = _verdict(lambda: done(stage, made.get(start), options, title.replace(" ", "-")))  # noqa: B023
        if isinstance(verdict, tuple):
            yield title, *verdict
            continue
        made[title] = verdict
        edited = title in ("source", "pruned", "trained", "qat")
        modules[title] = load_modules(verdict)["main"] if edited else modules[start]
        if limit is None:
            continue
        distance = far(verdict, modules[title])
        yield title, "right" if distance <= limit else "wrong", f"{distance:.2g}"


def _verdict(run: Any) -> Any:
    """Return what a stage gives, or how it ended."""
    from vlatool.errors import VlatoolError

    try:
        return run()
    except VlatoolError as error:
        return ("refused" if error.fix else "wrong"), f"{error}"
    except Exception as error:  # what no stage may end with
        return "wrong", f"{type(error).__name__}: {error}"


def main() -> int:
    """Try kinds and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", choices=[[], *KINDS], help="all when none is named")
    wrong = 0
    for name in parser.parse_args().kinds or KINDS:
        with tempfile.TemporaryDirectory() as place:
            for stage, verdict, about in tried(name, Path(place)):
                print(f"{name:22} {stage:15} {verdict:8} {about}", flush=True)
                unexpected = KINDS[name].refused and verdict == "right"
                wrong += verdict == "wrong" or unexpected
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
