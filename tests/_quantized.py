"""What the tests of quantization share: quantize, and compare actions over the recording."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context, Transform


@pytest.fixture
def quantized(float_bundle: Bundle, tmp_path: Path) -> Callable[..., Bundle]:
    """A function that runs a stage on the float bundle (or another) into a fresh directory."""
    made: list[Path] = []

    def run(stage: Transform, source: Bundle | None = None) -> Bundle:
        out = tmp_path / f"quantized-{len(made)}"
        out.mkdir()
        made.append(out)
        return stage.run(source or float_bundle, out, Context()).bundle

    return run


@pytest.fixture
def drift(float_bundle: Bundle) -> Callable[..., float]:
    """A function that gives the relative L2 difference of a bundle's actions to the float bundle's (or another's)."""

    def compute(bundle: Bundle, reference: Bundle | None = None) -> float:
        observations = recorded_observations(float_bundle, 12, float_bundle.path / "data/evaluation.npz")
        wanted, got = (actions(each, observations) for each in (reference or float_bundle, bundle))
        return relative_error(got, wanted)

    return compute


def actions(bundle: Bundle, observations: list[dict[str, Any]]) -> np.ndarray:
    policy = load(bundle.path, threads=1)
    return np.stack([policy.infer(observation).outputs["action"] for observation in observations])


@pytest.fixture
def operators() -> Callable[[Bundle], dict[str, int]]:
    """A function that counts the operators of a bundle's graph."""

    def count(bundle: Bundle) -> dict[str, int]:
        kinds = [node.op_type for node in onnx.load(bundle.path / "graphs/main.onnx").graph.node]
        return {kind: kinds.count(kind) for kind in sorted(set(kinds))}

    return count
