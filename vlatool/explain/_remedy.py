"""What to do about it: candidates that are really made, and measured beside the bundle as it is."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.explain._islands import Fallback
from vlatool.explain._operators import raw_actions, reference_engine
from vlatool.measurement.interleaved import Contestant, run_interleaved
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.engine import engine_class
from vlatool.runtime.policy import Policy, relative_error
from vlatool.sensitivity.layers import LayerError
from vlatool.stage.base import Context, Stage, Transform
from vlatool.stage.run import run_transform

MOST_LAYERS = (1, 2, 4)
"""How many of the worst layers the candidates leave in float32."""
SLOWER = 1.10
"""A candidate may be so much slower than the bundle as it is and still be suggested for its accuracy."""
BETTER = 0.9
"""A candidate is suggested when it makes the error, or the latency, at most so much of what it is."""
NEAR = 1.25
"""Of those within so much of the least error the one that changes least is suggested."""
ITERATIONS = 40


@dataclass
class Candidate:
    """One change of the quantization, made and measured.

    Args:
        name: What is changed, in words.
        stage: With the change.
        layers: How many further layers stay in float32.
        bundle: None until it was made.
        error: Relative L2 error of the raw action to float32, mean over the observations.
        contestant: Holds its latencies.
        failed: Why it could not be made.
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
        """Median latency in ms, NaN when it was not measured."""
        return float(np.median(self.contestant.samples)) if self.contestant else float("nan")


@dataclass(frozen=True)
class Contest:
    """Bundles measured in one run.

    Args:
        now: The bundle as it is.
        baseline: The float32 bundle; None when it was not found.
        others: What was tried.
    """

    now: Candidate
    baseline: Candidate | None
    others: list[Candidate] = field(default_factory=list)

    @property
    def speed(self) -> float:
        """Median latency of float32 over that of the bundle as it is; NaN without float32."""
        return self.baseline.ms / self.now.ms if self.baseline is not None else float("nan")

    @property
    def suggested(self) -> Candidate | None:
        """Return the candidate that helps most for the least change; None when none does."""
        fair = [candidate for candidate in self.others if candidate.error <= self.now.error * NEAR]
        exact = [
            candidate
            for candidate in fair
            if candidate.error <= BETTER * self.now.error and candidate.ms <= SLOWER * self.now.ms
        ]
        if exact:
            least = min(candidate.error for candidate in exact)
            return min(
                (candidate for candidate in exact if candidate.error <= NEAR * least),
                key=lambda candidate: candidate.layers,
            )
        fast = [candidate for candidate in fair if candidate.ms <= BETTER * self.now.ms]
        return min(fast, key=lambda candidate: candidate.ms) if fast else None


def plans(stage: Stage | None, worst: Sequence[LayerError], fallen: Sequence[Fallback], engine: str) -> list[Candidate]:
    """Return the candidates for a stage: the worst layers in float32, other ranges, the layout for the engine."""
    tried: list[Candidate] = []
    fixed, before = stage, ""
    if isinstance(stage, StaticInt8) and fallen:
        integer = next((name for name, layout in engine_class(engine).layouts.items() if layout.integer), stage.layout)
        if stage.layout != integer:
            fixed, before = stage.model_copy(update={"layout": integer}), f"layout {integer}"
        elif stage.activations != "auto":
            fixed, before = stage.model_copy(update={"activations": "auto"}), "activations auto"
        if before:
            tried.append(Candidate(before, fixed))
    if isinstance(fixed, StaticInt8 | DynamicInt8):
        for count in MOST_LAYERS:
            if count < len(worst):
                names = tuple(pattern(layer.name) for layer in worst[:count])
                words = f"without {count} layer{'s' if count > 1 else ''}"
                changed = fixed.model_copy(update={"exclude": (*fixed.exclude, *names)})
                tried.append(Candidate(", ".join(filter(None, (before, words))), changed, count))
    if isinstance(fixed, StaticInt8) and fixed.method == "minmax" and worst:
        words = ", ".join(filter(None, (before, "method mse")))
        tried.append(Candidate(words, fixed.model_copy(update={"method": "mse"})))
    return tried


def pattern(name: str) -> str:
    """Return a glob that matches a node's name and nothing else."""
    return re.sub(r"([\[*?])", r"[\1]", name)


def measure(
    bundle: Bundle,
    baseline: Bundle | None,
    tried: Sequence[Candidate],
    observations: Sequence[Mapping[str, Any]],
    scratch: Path,
    threads: int,
    context: Context,
) -> Contest:
    """Make the candidates and measure error and interleaved latency of all.

    Args:
        bundle: As it is.
        baseline: float32.
        tried: From ``plans``.
        observations: Raw observations that the errors and latencies are taken on.
        scratch: Where the candidates are made.
        threads: Intra-op threads.
        context: For progress.
    """
    now = Candidate("as it is", None, bundle=bundle)
    base = Candidate("float32", None, bundle=baseline) if baseline is not None else None
    for number, candidate in enumerate(tried):
        context.progress(f"making a candidate: {candidate.name}", None)
        if baseline is None or not isinstance(candidate.stage, Transform):
            continue
        try:
            candidate.bundle = run_transform(candidate.stage, baseline, scratch / str(number), Context())
        except VlatoolError as error:
            candidate.failed = error.message
    candidates = [
        candidate for candidate in (base, now, *tried) if candidate is not None and candidate.bundle is not None
    ]
    reference: list[Any] = []
    for candidate in candidates:
        if candidate.bundle is None:
            continue
        context.progress(f"errors of the candidate: {candidate.name}", None)
        engine = reference_engine(bundle) if candidate is base else ""
        policy = Policy.open(candidate.bundle, engine=engine, threads=threads, seed=0)
        outputs = raw_actions(policy, observations)
        if base is not None:
            reference = reference or outputs
            candidate.error = float(np.mean([relative_error(*pair) for pair in zip(outputs, reference, strict=True)]))
        candidate.contestant = Contestant(
            candidate.name, candidate.bundle, policy, [dict(item) for item in observations]
        )
    run_interleaved(
        [candidate.contestant for candidate in candidates if candidate.contestant], ITERATIONS, 5, context.progress
    )
    return Contest(now, base, [candidate for candidate in tried if candidate.bundle is not None])
