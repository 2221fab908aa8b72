"""Candidates for improvement, built and measured together with the current bundle."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.explain._float_roundtrips import Fallback
from vlatool.explain._operators import raw_actions, reference_engine
from vlatool.files.printable import amount
from vlatool.measurement.interleaved import Contestant, run_interleaved
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.engine import engine_class
from vlatool.runtime.policy import Policy, relative_error
from vlatool.sensitivity.layers import LayerError
from vlatool.stage.base import Context, Stage, Transform
from vlatool.stage.run import run_transform

EXCLUDED_LAYERS = (1, 2, 4)
"""Numbers of the worst layers that the candidates keep in float32."""
MAX_SLOWDOWN = 1.10
"""Largest ratio of the latency of a candidate that is suggested for its accuracy."""
MAX_REMAINING = 0.9
"""Largest ratio of error, or latency, to that of the current bundle for a suggestion."""
NEAR_BEST = 1.25
"""Largest ratio to the least error within which the smallest change is preferred."""
ITERATIONS = 40


@dataclass
class Candidate:
    """A changed quantization, built and measured.

    Args:
        name: Description of the change.
        layers: Number of additional layers in float32.
        bundle: The new bundle; None until it is built.
        error: Relative L2 error of the raw action to float32, mean over the observations.
        failed: Reason why it could not be built.
    """

    name: str
    stage: Stage | None
    layers: int = 0
    bundle: Bundle | None = None
    error: float = float("nan")
    contestant: Contestant | None = None
    failed: str = ""

    @property
    def ms(self) -> float:
        """Median latency in ms, NaN when not measured."""
        return float(np.median(self.contestant.samples)) if self.contestant else float("nan")


@dataclass(frozen=True)
class Comparison:
    """Bundles measured in one run.

    Args:
        current: The bundle to explain.
        baseline: The float32 bundle; None when it was not found.
    """

    current: Candidate
    baseline: Candidate | None
    others: list[Candidate] = field(default_factory=list)

    @property
    def speed(self) -> float:
        """Median latency of float32 over that of the current bundle; NaN without float32."""
        return self.baseline.ms / self.current.ms if self.baseline is not None else float("nan")

    @property
    def suggestion(self) -> Candidate | None:
        """The candidate with the largest improvement for the least change; None when none improves enough."""
        fair = [candidate for candidate in self.others if candidate.error <= self.current.error * NEAR_BEST]
        exact = [
            candidate
            for candidate in fair
            if candidate.error <= MAX_REMAINING * self.current.error and candidate.ms <= MAX_SLOWDOWN * self.current.ms
        ]
        if exact:
            least = min(candidate.error for candidate in exact)
            return min(
                (candidate for candidate in exact if candidate.error <= NEAR_BEST * least),
                key=lambda candidate: candidate.layers,
            )
        fast = [candidate for candidate in fair if candidate.ms <= MAX_REMAINING * self.current.ms]
        return min(fast, key=lambda candidate: candidate.ms) if fast else None


def plan_candidates(
    stage: Stage | None, worst: Sequence[LayerError], fallbacks: Sequence[Fallback], engine: str
) -> list[Candidate]:
    """Return the candidates for a stage: the worst layers in float32, other ranges, the layout for the engine."""
    candidates: list[Candidate] = []
    fixed, before = stage, ""
    if isinstance(stage, StaticInt8) and fallbacks:
        integer = next((name for name, layout in engine_class(engine).layouts.items() if layout.integer), stage.layout)
        if stage.layout != integer:
            fixed, before = stage.model_copy(update={"layout": integer}), f"layout {integer}"
        elif stage.activations != "auto":
            fixed, before = stage.model_copy(update={"activations": "auto"}), "activations auto"
        if before:
            candidates.append(Candidate(before, fixed))
    if isinstance(fixed, StaticInt8 | DynamicInt8):
        for count in EXCLUDED_LAYERS:
            if count < len(worst):
                names = tuple(pattern(layer.name) for layer in worst[:count])
                words = f"without {amount(count, 'layer')}"
                changed = fixed.model_copy(update={"exclude": (*fixed.exclude, *names)})
                candidates.append(Candidate(", ".join(filter(None, (before, words))), changed, count))
    if isinstance(fixed, StaticInt8) and fixed.method == "minmax" and worst:
        words = ", ".join(filter(None, (before, "method mse")))
        candidates.append(Candidate(words, fixed.model_copy(update={"method": "mse"})))
    return candidates


def pattern(name: str) -> str:
    """Return a glob that matches only the given name."""
    return re.sub(r"([\[*?])", r"[\1]", name)


def measure(
    bundle: Bundle,
    baseline: Bundle | None,
    tried: Sequence[Candidate],
    observations: Sequence[Mapping[str, Any]],
    scratch: Path,
    threads: int,
    context: Context,
) -> Comparison:
    """Build the candidates and measure error and interleaved latency of all."""
    current = Candidate("as it is", None, bundle=bundle)
    base = Candidate("float32", None, bundle=baseline) if baseline is not None else None
    for number, candidate in enumerate(tried):
        context.progress(f"making a candidate: {candidate.name}", None)
        if baseline is None or not isinstance(candidate.stage, Transform):
            continue
        try:
            candidate.bundle = run_transform(candidate.stage, baseline, scratch / str(number), Context()).bundle
        except VlatoolError as error:
            candidate.failed = error.message
    reference: list[Any] = []
    contestants: list[Contestant] = []
    for candidate in filter(None, (base, current, *tried)):
        if candidate.bundle is None:
            continue
        context.progress(f"errors of the candidate: {candidate.name}", None)
        engine = reference_engine(bundle) if candidate is base else ""
        policy = Policy.open(candidate.bundle, engine=engine, threads=threads, seed=0)
        outputs = raw_actions(policy, observations)
        if base is not None:
            reference = reference or outputs
            candidate.error = float(np.mean([relative_error(*pair) for pair in zip(outputs, reference, strict=True)]))
        contestants.append(Contestant(candidate.name, candidate.bundle, policy, list(map(dict, observations))))
        candidate.contestant = contestants[-1]
    run_interleaved(contestants, ITERATIONS, 5, context.progress)
    return Comparison(current, base, [candidate for candidate in tried if candidate.bundle is not None])
