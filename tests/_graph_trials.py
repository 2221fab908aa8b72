"""One random graph through one method: is it quantized or refused for a reason, does it load, how far is it off?"""

from __future__ import annotations

import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from _arithmetic import full_range_or_less
from _random_graphs import RandomGraph

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.onnx import OnnxFile
from vlatool.stage.base import Context, Transform
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

INT4, INT8 = 0.6, 0.15
"""Largest relative L2 drift from float32 of graphs of a few random layers."""
METHODS: dict[str, tuple[str, dict[str, Any], float]] = {
    "int4": ("quantize.weight_only", {}, INT4),
    "int4-qdq": ("quantize.weight_only", {"layout": "qdq"}, INT4),
    "int8-weights": ("quantize.weight_only", {"bits": 8}, INT8),
    "hqq": ("quantize.weight_only", {"method": "hqq"}, INT4),
    "gptq": ("quantize.weight_only", {"method": "gptq"}, INT4),
    "gptq-qdq": ("quantize.weight_only", {"method": "gptq", "layout": "qdq"}, INT4),
    "gptq-int8": ("quantize.weight_only", {"method": "gptq", "bits": 8, "symmetric": True}, INT8),
    "awq": ("quantize.weight_only", {"method": "awq"}, INT4),
    "awq-qdq": ("quantize.weight_only", {"method": "awq", "layout": "qdq"}, INT4),
    "awq-int8": ("quantize.weight_only", {"method": "awq", "bits": 8}, INT8),
    "dynamic": ("quantize.dynamic_int8", {}, INT8),
    "static": ("quantize.static_int8", {}, INT8),
    "static-all": ("quantize.static_int8", {"attention": True, "elementwise": True}, INT8),
    "static-qdq": ("quantize.static_int8", {"layout": "qdq", "activations": "int8"}, INT8),
    "static-openvino": ("quantize.static_int8", {"layout": "openvino"}, INT8),
    "static-openvino-all": (
        "quantize.static_int8",
        {"layout": "openvino", "attention": True, "elementwise": True},
        INT8,
    ),
    "smooth": ("quantize.smooth_quant", {"insert": True, "outliers": 1.0}, 1e-4),
    "float16": ("quantize.float16", {}, 0.02),
}
"""Word -> stage, options, and the largest drift."""
CALIBRATED = ("gptq", "awq", "static", "smooth")


@dataclass(frozen=True)
class Outcome:
    """What became of a graph.

    Args:
        verdict: ``right``, ``refused`` (an error of vlatool's own with a reason), ``drift`` or ``crash``.
        drift: Relative L2 drift of the actions from float32's, where it ran.
        words: The reason.
    """

    verdict: str
    drift: float = 0.0
    words: str = ""


def float_graph(graph: RandomGraph, folder: Path) -> Bundle:
    """Write a graph and its recording, and return its float32 bundle."""
    folder.mkdir(parents=True)
    onnx.save(graph.model, str(folder / "model.onnx"))
    np.savez(folder / "recording.npz", **graph.recording())
    return run_transform(OnnxFile(model=folder / "model.onnx"), None, folder / "float", Context()).bundle


def trial(graph: RandomGraph, source: Bundle, word: str) -> Outcome:
    """Quantize the float32 bundle of a graph, load what comes out and compare it on observations of its own."""
    name, options, limit = METHODS[word]
    given = dict(options) | (full_range_or_less() if options.get("layout") == "openvino" else {})
    if word.split("-")[0] in CALIBRATED:
        given["calibration"] = str(source.path.parent / "recording.npz")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = run_transform(stage_of(name, given), source, source.path.parent / word, Context()).bundle
        errors = _drifts(graph, source, made)
    except VlatoolError as error:
        return Outcome("refused", words=f"{type(error).__name__}: {error.message}")
    except Exception:
        return Outcome("crash", words=traceback.format_exc())
    drift = float(np.mean(errors))
    findings = "; ".join(str(each["message"]) for each in made.manifest.findings)
    wrong = not drift <= limit or findings
    return Outcome("drift" if wrong else "right", drift, findings)


def stage_of(name: str, options: dict[str, Any]) -> Transform:
    """Return a stage by its name."""
    made = build_stage(name, options)
    assert isinstance(made, Transform)
    return made


def _drifts(graph: RandomGraph, source: Bundle, made: Bundle) -> list[float]:
    recorded = graph.recording(4, seed=1)
    policies = [load(bundle.path, threads=1) for bundle in (source, made)]
    found = []
    for number in range(4):
        observation = {name: values[number] for name, values in recorded.items()}
        wanted, got = (
            np.concatenate([value.reshape(-1) for value in policy.infer(observation).outputs.values()])
            for policy in policies
        )
        found.append(relative_error(got, wanted))
    return found
