"""What a policy would do on a board: a time line of its phases, where each is bound, and what a change would give."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from vlatool.graph.workload import GraphWorkload, Workload
from vlatool.latency_model.board import Candidate, Outcome, Phase, outcomes, rescale, stored_quantization
from vlatool.latency_model.features import Shares, roofline_parts
from vlatool.latency_model.model import LatencyModel, part_of

PRUNED_SHARE = 0.7
SMALLER = 0.5
"""Share of the pixels, and so of the tokens, that images keep at 0.7 of their side."""


@dataclass(frozen=True)
class Bound:
    """One phase and what holds it back: ``compute``, ``memory``, ``overhead`` -> share of its roofline time (0-1)."""

    phase: Phase
    shares: Mapping[str, float]

    @property
    def by(self) -> str:
        """What takes most of it."""
        return max(self.shares, key=lambda name: self.shares[name])


@dataclass(frozen=True)
class Change:
    """What one change would give: ``outcome`` is the changed policy on the same board."""

    name: str
    outcome: Outcome


def bounds(outcome: Outcome, shares: Mapping[str, Shares]) -> list[Bound]:
    """Return each phase with what holds it back."""
    phases = []
    for phase in outcome.phases:
        parts = roofline_parts(phase.question, shares[part_of(phase.question)])
        whole = sum(parts.values())
        phases.append(Bound(phase, {name: value / whole for name, value in parts.items()}))
    return phases


def parts_of(phase: Phase, graph: GraphWorkload, shares: Mapping[str, Shares]) -> dict[str, float]:
    """Return part of the policy -> its share (0-1) of a graph's time, by the roofline of its layers alone.

    What belongs to no part is ``other``; nothing when the policy names no parts.
    """
    milliseconds = {}
    for part, (macs, weights, activations, layers) in graph.parts.items():
        work = replace(phase.question.work, macs=macs, weights=weights, activations=activations, layers=layers)
        rates = shares[part_of(phase.question)]
        milliseconds[part or "other"] = sum(roofline_parts(replace(phase.question, work=work), rates).values())
    whole = sum(milliseconds.values()) or 1.0
    return {part: ms / whole for part, ms in milliseconds.items()}


def changes(candidate: Candidate, load: Workload, model: LatencyModel) -> list[Change]:
    """Predict what the usual changes would give: other precisions, fewer steps, smaller images, pruning."""
    asked: list[tuple[str, Candidate, Workload]] = []
    now = candidate.precision or stored_quantization(load) or "float32"
    whole = not stored_quantization(load)
    asked += [
        (f"{precision} in the place of {now}", replace(candidate, precision=precision), load)
        for precision in candidate.figures.dtypes
        if precision != now and whole
    ]
    for name, runs in load.runs.items():
        if runs > 1:
            fewer = rescale(load, {}, {name: math.ceil(runs / 2)})
            asked.append((f"{name}: {math.ceil(runs / 2)} steps in the place of {runs}", candidate, fewer))
    name = widest(load)
    images = rescale(load, {name: (SMALLER, 1.0, SMALLER)})
    asked.append((f"images of 0.7 of the side, where {name} works on image tokens alone", candidate, images))
    pruned = dict.fromkeys(load.graphs, (PRUNED_SHARE, PRUNED_SHARE, math.sqrt(PRUNED_SHARE)))
    asked.append(("30 % of each layer pruned, whole channels", candidate, rescale(load, pruned)))
    return [Change(title, outcomes([way], changed, model)[0]) for title, way, changed in asked]


def widest(load: Workload) -> str:
    """Return the graph that has most activations for its weights: the one that works on images."""
    return max(load.graphs, key=lambda name: load.graphs[name].activations / max(1, load.graphs[name].weights))


def timeline(phases: list[Bound], width: int = 40) -> Iterator[str]:
    """Return a line for each phase: name, bar from begin to end, milliseconds, what holds it back."""
    whole = sum(bound.phase.ms for bound in phases) or 1.0
    begin = 0.0
    for bound in phases:
        phase = bound.phase
        start, end = round(begin / whole * width), round((begin + phase.ms) / whole * width)
        bar = " " * start + "█" * max(1, end - start)
        times = f" {phase.runs}x{phase.once.ms:.3g}" if phase.runs > 1 else ""
        held = f"{bound.shares[bound.by]:.0%} {bound.by}"
        yield f"{phase.name[:16]:16} {bar:{width + 1}} {phase.ms:8.3g} ms{times}  {held}"
        begin += phase.ms
