"""Effect of bfloat16 on phases: measured with the phases in bfloat16 and in float32."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.explain._operators import raw_actions
from vlatool.files.scratch import scratch_directory
from vlatool.graph.files import load, save, split_phases
from vlatool.graph.phase import cut_phases, periodic_nodes
from vlatool.runtime.engine import computing, engine_class
from vlatool.runtime.policy import Policy, relative_error
from vlatool.runtime.program import Program, Session
from vlatool.stage.base import Context

REASON = (
    "bfloat16 has 8 significant bits: a position or denoising time times a frequency of hundreds of radians, rounded "
    "to them, is off by up to a radian, and its sine is noise that no later layer repairs"
)


@dataclass(frozen=True)
class Phases:
    """Effect of bfloat16 on the phases of one graph.

    Args:
        kept: Name of the float32 graph that its phases were moved to; empty when they were not moved.
        nodes: Names of its Sin and Cos that depend on an input and are computed in bfloat16.
        error: Relative error of the actions to float32 with the phases in bfloat16; NaN when not measured.
        cut: The same with the phases in float32; NaN when not measured.
        note: Reason why it was not cut or not measured.
    """

    graph: str
    kept: str = ""
    nodes: tuple[str, ...] = ()
    error: float = float("nan")
    cut: float = float("nan")
    note: str = ""


def measure_phases(
    bundle: Bundle, baseline: Bundle | None, observations: Sequence[Mapping[str, Any]], context: Context
) -> list[Phases]:
    """Return the effect on each graph of a bundle that computes in bfloat16.

    Args:
        baseline: The float32 bundle, to measure the bundle without its cuts.
    """
    effects = []
    graphs = bundle.manifest.graphs
    for name, graph in graphs.items():
        if graph.compute != "bfloat16":
            continue
        kept = f"{name}_phases" if f"{name}_phases" in graphs else ""
        nodes = tuple(node.name for node in periodic_nodes(load(bundle.file(graph.file))))
        state = Phases(name, kept, nodes)
        if nodes:
            effects.append(_with_cut(bundle, state, observations, context))
        elif kept:
            whole = set(graph.precision) <= {"bfloat16", "float32"}  # else int8 errors would be mixed in
            base = baseline if whole else None
            effects.append(_without_cut(bundle, base, state, observations, context) if base else state)
    return effects


def _without_cut(
    bundle: Bundle, baseline: Bundle, phase: Phases, observations: Sequence[Mapping[str, Any]], context: Context
) -> Phases:
    """Run float32, the bundle with its cut, and the whole float32 graph in bfloat16."""
    context.progress(f"measuring the phases of {phase.graph} in bfloat16", None)
    graphs = baseline.manifest.graphs
    try:
        plain = _actions(baseline, {}, observations, dict.fromkeys(graphs, ""))
        computes = {name: graph.compute for name, graph in bundle.manifest.graphs.items() if name in graphs}
        uncut = _actions(baseline, {}, observations, computes)
        cut = _actions(bundle, {}, observations, {})
    except VlatoolError as error:
        return replace(phase, note=f"not measured: {error.message}")
    return replace(phase, error=_error(uncut, plain), cut=_error(cut, plain))


def _with_cut(bundle: Bundle, phase: Phases, observations: Sequence[Mapping[str, Any]], context: Context) -> Phases:
    """Run float32, the bundle itself, and the bundle with the cut."""
    context.progress(f"measuring the effect of bfloat16 on the phases of {phase.graph}", None)
    manifest = bundle.manifest
    note = ""
    with scratch_directory() as scratch:
        path = scratch / f"{phase.graph}.onnx"
        model = load(bundle.file(manifest.graphs[phase.graph].file))
        save(model, path)
        if cut_phases(model) is None:
            note = "the network itself computes the phase, so it cannot be cut out"
        program, phase_graphs = split_phases(manifest.program, phase.graph, path)
        if not phase_graphs:
            note = note or "the graph runs in a loop, which a program cannot split between two graphs"
        try:
            plain = _actions(bundle, {}, observations, dict.fromkeys(manifest.graphs, ""))
            now = _actions(bundle, {}, observations, {})
            replaced = {phase.graph: path, **{name: path.with_name(f"{name}.onnx") for name in phase_graphs}}
            cut = _actions(bundle, replaced, observations, {}, program) if phase_graphs else []
        except VlatoolError as error:
            return replace(phase, note=f"not measured: {error.message}")
    return replace(phase, error=_error(now, plain), cut=_error(cut, plain) if cut else float("nan"), note=note)


def _actions(
    bundle: Bundle,
    replaced: Mapping[str, Path],
    observations: Sequence[Mapping[str, Any]],
    computes: Mapping[str, str],
    program: Any = None,
) -> list[Any]:
    """Return the raw actions with some graphs read from elsewhere or computed in another dtype."""
    manifest = bundle.manifest
    engine = computing("bfloat16")
    library = engine_class(engine)
    sessions: dict[str, Session] = {}
    for name, graph in manifest.graphs.items():
        path = replaced.get(name) or bundle.file(graph.file)
        sessions[name] = library(path, 1, computes.get(name, graph.compute))
    for name, path in replaced.items():
        sessions.setdefault(name, library(path, 1, ""))
    policy = Policy(bundle, Program(program or manifest.program, sessions, seed=0), engine)
    return raw_actions(policy, observations)


def _error(got: Sequence[Any], reference: Sequence[Any]) -> float:
    return float(np.mean([relative_error(*pair) for pair in zip(got, reference, strict=True)]))


def phase_sentences(effects: Sequence[Phases], again: str) -> list[str]:
    """Return the sentences, the bad news first; ``again`` is the command that makes the bundle again."""
    sentences = []
    for phase in sorted(effects, key=lambda item: not item.nodes):
        if phase.kept:
            text = f"The phases of {phase.graph} stay in float32, in the graph {phase.kept}: {REASON}."
            if not phase.nodes and phase.error == phase.error:
                text += f" Measured: relative error {phase.cut:.3g}; it would be {phase.error:.3g} all in bfloat16."
            sentences.append(text)
        if phase.nodes:
            sentences.append(_damage_sentence(phase, again))
    return sentences


def _damage_sentence(phase: Phases, again: str) -> str:
    nodes = ", ".join(phase.nodes[:3]) + (f" and {len(phase.nodes) - 3} more" if len(phase.nodes) > 3 else "")
    text = f"{phase.graph} computes {nodes} of its inputs in bfloat16, which ruins such phases: {REASON}."
    if phase.error == phase.error:
        text += f" Measured: relative error {phase.error:.3g} now"
        text += f", {phase.cut:.3g} with the phases in float32" if phase.cut == phase.cut else ""
        text += "."
    if phase.note:
        text += f" {phase.note[0].upper()}{phase.note[1:]}."
    elif phase.cut < phase.error:
        text += f" Make it again: {again}"
    return text
