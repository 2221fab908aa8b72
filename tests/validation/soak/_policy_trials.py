"""One random policy through export, every quantization method and both engines: what became of each bundle."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from _arithmetic import full_range_or_less
from _random_policies import RandomPolicy

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.torch_policy import torch_policy
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources import source_stage
from vlatool.stage.base import Context, Transform
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

ENGINES = ("ort_cpu", "openvino")
FLOAT, HALF, EIGHT_BITS, AT_RUN_TIME, INT8, INT4 = 1e-4, 0.005, 0.05, 0.1, 0.25, 0.7
"""Largest relative L2 drift of the actions from torch, of networks of a few random layers: up to three times what the
worst of 300 policies lost when no defect was left (docs/measurements/robustness.md)."""
METHODS: dict[str, tuple[str, dict[str, Any], float]] = {
    "static": ("quantize.static_int8", {}, INT8),
    "static-all": ("quantize.static_int8", {"attention": True, "elementwise": True}, 2 * INT8),
    "static-qdq": ("quantize.static_int8", {"layout": "qdq"}, INT8),
    "static-openvino": ("quantize.static_int8", {"layout": "openvino"}, INT8),
    "dynamic": ("quantize.dynamic_int8", {}, AT_RUN_TIME),
    "smooth": ("quantize.smooth_quant", {"insert": True, "outliers": 1.0}, FLOAT),
    "float16": ("quantize.float16", {}, HALF),
    "float8": ("quantize.float8", {}, INT8),
    "bfloat16": ("quantize.bfloat16", {}, EIGHT_BITS),
    "int8-weights": ("quantize.weight_only", {"bits": 8}, EIGHT_BITS),
    "int4": ("quantize.weight_only", {}, INT4),
    "int4-qdq": ("quantize.weight_only", {"layout": "qdq"}, INT4),
    "hqq": ("quantize.weight_only", {"method": "hqq"}, INT4),
    "gptq": ("quantize.weight_only", {"method": "gptq"}, INT4),
    "awq": ("quantize.weight_only", {"method": "awq"}, INT4),
}
"""Word -> stage, options, and the largest drift."""
CALIBRATED = ("static", "static-all", "static-qdq", "static-openvino", "float8")
"""Methods whose activations have ranges from a recording: what leaves them is clipped."""
EXPORT = "export"
FRESH = 1000
"""Added to a policy's seed for observations that calibration has not seen."""
Place = tuple[str, str]
"""A method, and the engine that loads what it made; no engine while it is made."""


@dataclass(frozen=True)
class Outcome:
    """What became of one bundle.

    Args:
        method: A key of ``METHODS``, or ``export``.
        engine: Which one loaded it; empty when it was not made.
        verdict: ``right``, ``refused``, ``uncovered``, ``drift`` or ``crash``. What drifts because the recording does
            not cover the observations that come after is ``uncovered``: calibrated with them, it does not drift.
        drift: Relative L2 drift of the actions from torch, where it ran.
        words: The reason.
    """

    method: str
    engine: str
    verdict: str
    drift: float = 0.0
    words: str = ""


def trials(
    policy: RandomPolicy,
    scratch: Path,
    methods: Collection[str],
    skip: Collection[Place] = (),
    begin: Callable[[Place], None] = lambda place: None,
) -> Iterator[Outcome]:
    """Take a policy through everything.

    Args:
        policy: What is exported.
        scratch: An empty directory.
        methods: Keys of ``METHODS``.
        skip: What is not tried; what else needs a skipped bundle still makes it.
        begin: Told of each trial before it starts, for whoever outlives this process.
    """
    trial = _Trial(policy, skip, begin)
    made: list[Bundle] = []

    def export() -> Bundle:
        source = run_transform(
            source_stage(str(policy.write(scratch / "policy"))), None, scratch / "source", Context()
        ).bundle
        (scratch / "float").mkdir()
        made.append(source)
        return ExportOnnx().run(source, scratch / "float", Context()).bundle

    exported, failed = trial.tried((EXPORT, ""), export)
    if exported is None:
        yield failed
        return
    wanted = answers(torch_policy(made[0], seed=0), policy)
    yield from trial.loaded(EXPORT, exported, wanted, FLOAT)
    for method in methods:
        if all(place in skip for place in places(method)):
            continue

        def quantize(method: str = method, word: str = "", **more: Any) -> Bundle:
            stage, options, _ = METHODS[method]
            exact = full_range_or_less() if options.get("layout") == "openvino" else {}
            built = build_stage(stage, {**options, **exact, **more})
            assert isinstance(built, Transform)
            return run_transform(built, exported, scratch / f"{method}{word}", Context()).bundle

        bundle, failed = trial.tried((method, ""), quantize)
        if bundle is None:
            yield failed
            continue
        covering: list[Bundle] = []
        for outcome in trial.loaded(method, bundle, wanted, METHODS[method][2]):
            if outcome.verdict == "drift" and method in CALIBRATED:
                recording = policy.record(scratch / "covering.npz", *fresh(policy))
                covering = covering or [quantize(word="-covering", calibration=str(recording))]
                outcome = trial.covered(outcome, covering[0], wanted, METHODS[method][2])
            yield outcome


def places(method: str) -> list[Place]:
    """Return what is tried of a method once its bundle is made."""
    return [(method, engine) for engine in ENGINES]


class _Trial:
    """The trials of one policy, each told of before it starts."""

    def __init__(self, policy: RandomPolicy, skip: Collection[Place], begin: Callable[[Place], None]) -> None:
        self.policy, self.skip, self.begin = policy, skip, begin

    def loaded(self, method: str, bundle: Bundle, wanted: list[Any], limit: float) -> Iterator[Outcome]:
        """Load a bundle with each engine and hold its actions against torch's."""
        for place in places(method):
            if place in self.skip:
                continue
            drift, failed = self.tried(place, lambda place=place: self.drift(bundle, place[1], wanted))
            if drift is None:
                yield failed
            else:
                yield Outcome(*place, "right" if drift <= limit else "drift", drift, f"limit {limit:g}")

    def covered(self, outcome: Outcome, bundle: Bundle, wanted: list[Any], limit: float) -> Outcome:
        """Return what became of a method that drifted, when it is calibrated with what is asked of it, too."""
        drift = self.drift(bundle, outcome.engine, wanted)
        words = f"{outcome.words}; calibrated with what it is asked: {drift:.3g}"
        return replace(outcome, verdict="uncovered" if drift <= limit else "drift", words=words)

    def drift(self, bundle: Bundle, engine: str, wanted: list[Any]) -> float:
        """Load a bundle with an engine and hold its actions against torch's."""
        got = answers(load(bundle.path, engine=engine, threads=1, seed=0), self.policy)
        return relative_error(np.stack(got), np.stack(wanted))

    def tried(self, place: Place, work: Callable[[], Any]) -> tuple[Any, Outcome]:
        """Return what some work gives, or what it ended with."""
        self.begin(place)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return work(), Outcome(*place, "right")
        except VlatoolError as error:
            return None, Outcome(*place, "crash" if error.exit_code == 70 else "refused", words=str(error))
        except Exception:  # the seam: whatever is no error of vlatool's own would be exit code 70
            return None, Outcome(*place, "crash", words=traceback.format_exc())


def fresh(policy: RandomPolicy) -> list[dict[str, Any]]:
    """Draw the observations that a policy is asked about."""
    return policy.observations(4, policy.seed + FRESH)


def answers(opened: Any, policy: RandomPolicy) -> list[Any]:
    """Return the actions for fresh observations, one after the other."""
    observations = fresh(policy)
    noises = [policy.noise(policy.seed + FRESH + turn) for turn in range(len(observations))]
    return [opened.infer(each, noise=noise).outputs["action"] for each, noise in zip(observations, noises, strict=True)]
