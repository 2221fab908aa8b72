"""Why some phases of a bfloat16 bundle are computed in float32, and what it costs a bundle that lacks the cut."""

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
from vlatool.graph.files import load, part_phases, save
from vlatool.graph.phase import cut_phases, periodic
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
    """What bfloat16 does to the phases of one graph.

    Args:
        graph: Name of the graph.
        kept: Name of the float32 graph that its phases were moved to; empty when they were not.
        nodes: Names of its Sin and Cos that depend on an input and are computed in bfloat16.
        error: Relative error of the actions to float32 with the phases in bfloat16; NaN when it was not measured.
        cut: The same with the phases in float32; NaN when it was not measured.
        note: Why it was not cut or not measured.
    """

    graph: str
    kept: str = ""
    nodes: tuple[str, ...] = ()
    error: float = float("nan")
    cut: float = float("nan")
    note: str = ""


def phases(
    bundle: Bundle, baseline: Bundle | None, observations: Sequence[Mapping[str, Any]], context: Context
) -> list[Phases]:
    """Return what is known of each graph of a bundle that computes in bfloat16.

    Args:
        bundle: What is explained.
        baseline: The float32 bundle, to measure what the bundle would be without its cuts.
        observations: Raw observations.
        context: For progress.
    """
    known = []
    graphs = bundle.manifest.graphs
    for name, graph in graphs.items():
        if graph.compute != "bfloat16":
            continue
        kept = f"{name}_phases" if f"{name}_phases" in graphs else ""
        nodes = tuple(node.name for node in periodic(load(bundle.file(graph.file))))
        state = Phases(name, kept, nodes)
        if nodes:
            known.append(_measured(bundle, state, observations, context))
        elif kept:
            whole = set(graph.precision) <= {"bfloat16", "float32"}  # else int8 errors would be mixed in
            known.append(_without(bundle, baseline, state, observations, context) if baseline and whole else state)
    return known


def _without(
    bundle: Bundle, baseline: Bundle, phase: Phases, observations: Sequence[Mapping[str, Any]], context: Context
) -> Phases:
    """Run float32, the bundle with its cut, and the whole float32 graph in bfloat16."""
    context.progress(f"measuring what the phases of {phase.graph} would be in bfloat16", None)
    graphs = baseline.manifest.graphs
    try:
        plain = _actions(baseline, {}, observations, dict.fromkeys(graphs, ""))
        computes = {name: graph.compute for name, graph in bundle.manifest.graphs.items() if name in graphs}
        uncut = _actions(baseline, {}, observations, computes)
        cut = _actions(bundle, {}, observations, {})
    except VlatoolError as error:
        return replace(phase, note=f"not measured: {error.message}")
    return replace(phase, error=_error(uncut, plain), cut=_error(cut, plain))


def _measured(bundle: Bundle, phase: Phases, observations: Sequence[Mapping[str, Any]], context: Context) -> Phases:
    """Run float32, the bundle as it is, and the bundle with the cut."""
    context.progress(f"measuring what bfloat16 does to the phases of {phase.graph}", None)
    manifest = bundle.manifest
    note = ""
    with scratch_directory() as scratch:
        path = scratch / f"{phase.graph}.onnx"
        model = load(bundle.file(manifest.graphs[phase.graph].file))
        save(model, path)
        if cut_phases(model) is None:
            note = "the network itself computes the phase, so that it cannot be cut out"
        program, parted = part_phases(manifest.program, phase.graph, path)
        if not parted:
            note = note or "the graph runs in a loop, which a program cannot share between two graphs"
        try:
            plain = _actions(bundle, {}, observations, dict.fromkeys(manifest.graphs, ""))
            now = _actions(bundle, {}, observations, {})
            replaced = {phase.graph: path, **{name: path.with_name(f"{name}.onnx") for name in parted}}
            cut = _actions(bundle, replaced, observations, {}, program) if parted else []
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


def _error(got: Sequence[Any], wanted: Sequence[Any]) -> float:
    return float(np.mean([relative_error(*pair) for pair in zip(got, wanted, strict=True)]))


def phase_sentences(known: Sequence[Phases], again: str) -> list[str]:
    """Return the sentences for a reader, the bad news first.

    Args:
        known: From ``phases``.
        again: The command that makes the bundle again.
    """
    sentences = []
    for phase in sorted(known, key=lambda item: not item.nodes):
        if phase.kept:
            text = f"The phases of {phase.graph} stay in float32, in the graph {phase.kept}: {REASON}."
            if not phase.nodes and phase.error == phase.error:
                text += f" Measured: relative error {phase.cut:.3g}; it would be {phase.error:.3g} all in bfloat16."
            sentences.append(text)
        if phase.nodes:
            sentences.append(_ruined(phase, again))
    return sentences


def _ruined(phase: Phases, again: str) -> str:
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
