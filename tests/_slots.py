"""Small bundles whose actions say which one they are, stores that hold them, and policies that fail on purpose."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.deployment.pointer import Slot, Trial
from vlatool.deployment.store import Store
from vlatool.runtime.identity import policy_identity
from vlatool.runtime.interface import Action
from vlatool.stage.finish import save_npz

X, Y = TensorSpec("x", (1, 2)), TensorSpec("y", (1, 3, 2), unit="rad")
TRIAL = Trial(ticks=4, seconds=1.0, latency_ms=100.0, memory_mb=64.0)
OBSERVATION = {"x": [1.0, 2.0]}


def bundle_of(folder: Path, value: float, version: str = "1.0.0", *, golden: bool = True, **changes: Any) -> Bundle:
    """Seal a policy that answers ``value`` in each element of a chunk of three actions."""
    (folder / "graphs").mkdir(parents=True)
    values = ", ".join([f"{value:f}"] * 6)
    text = f"""g (float[1,2] x) => (float[1,3,2] y) <int64[1] a = {{1}}, float[1,3,2] v = {{{values}}}> {{
        n = Sub(x, x)  u = Unsqueeze(n, a)  y = Add(v, u)
    }}"""
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}')
    onnx.save(model, str(folder / "graphs/main.onnx"))
    spec = replace(PolicySpec((X,), (Y,), 10.0, chunk=3), **changes)
    manifest = Manifest("toy", version, spec, program=single_graph(spec))
    if golden:
        (folder / "golden").mkdir()
        stored = {"in.x": np.ones((1, 2)), "out.y": np.full((1, 1, 3, 2), value)}
        save_npz(folder / "golden/golden.npz", {name: array.astype(np.float32) for name, array in stored.items()})
        manifest = replace(manifest, golden="golden/golden.npz")
    sealed = seal(folder, replace(manifest, golden="")).manifest
    graphs = {"main": Graph("graphs/main.onnx", opset=20)}
    return seal(folder, replace(sealed, graphs=graphs, golden=manifest.golden))


def install(store: Store, bundle: Bundle, trial: Trial | None = TRIAL, release: int = 0) -> Slot:
    """Make a bundle the active one without trying it out."""
    store.make()
    manifest = bundle.manifest
    with store.lock() as pointer:
        pointer, copy = store.fill(pointer, bundle)
        slot = Slot(copy.hash, policy_identity(copy), manifest.name, manifest.version, release)
        store.activate(pointer, slot, trial)
    return slot


class FakePolicy:
    """A policy whose actions hold one value; ``act`` may replace the answer of an inference by its number."""

    def __init__(self, spec: PolicySpec, value: float, act: Callable[[int], Any] | None = None) -> None:
        self.spec, self.value, self._act = spec, value, act
        self.inferences, self.resets = 0, 0

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Action:
        """Answer one chunk."""
        self.inferences += 1
        answer = self._act(self.inferences) if self._act else None
        chunk = np.full((3, 2), self.value, np.float32) if answer is None else answer
        return Action(chunk, (), 0.1, self.inferences - 1, {})

    def reset(self, seed: int | None = None) -> None:
        """Count it."""
        self.resets += 1


class Clock:
    """A clock that stands until it is moved."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        """Return the time."""
        return self.now
