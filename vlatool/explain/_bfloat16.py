"""Why some phases of a bfloat16 bundle are computed in float32, and what it costs a bundle that lacks the cut."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
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
    found = []
    graphs = bundle.manifest.graphs
    for name, graph in graphs.items():
        if graph.compute != "bfloat16":
            continue
        kept = f"{name}_phases" if f"{name}_phases" in graphs else ""
        nodes = tuple(node.name for node in periodic(load(bundle.file(graph.file))))
        each = Phases(name, kept, nodes)
        if nodes:
            found.append(_measured(bundle, each, observations, context))
        elif kept:
            whole = set(graph.precision) <= {"bfloat16", "float32"}  # else int8 errors would be mixed in
            found.append(_without(bundle, baseline, each, observations, context) if baseline and whole else each)
    return found


def _without(
    bundle: Bundle, baseline: Bundle, each: Phases, observations: Sequence[Mapping[str, Any]], context: Context
) -> Phases:
    """Run float32, the bundle with its cut, and the whole float32 graph in bfloat16."""
    context.tell(f"measuring what the phases of {each.graph} would be in bfloat16", None)
    graphs = baseline.manifest.graphs
    try:
        plain = _actions(baseline, {}, observations, dict.fromkeys(graphs, ""))
        computes = {name: made.compute for name, made in bundle.manifest.graphs.items() if name in graphs}
        uncut = _actions(baseline, {}, observations, computes)
        cut = _actions(bundle, {}, observations, {})
    except VlatoolError as error:
        return replace(each, note=f"not measured: {error.message}")
    return replace(each, error=_error(uncut, plain), cut=_error(cut, plain))


def _measured(bundle: Bundle, each: Phases, observations: Sequence[Mapping[str, Any]], context: Context) -> Phases:
    """Run float32, the bundle as it is, and the bundle with the cut."""
    context.tell(f"measuring what bfloat16 does to the phases of {each.graph}", None)
    manifest = bundle.manifest
    note = ""
    with tempfile.TemporaryDirectory(prefix="vlatool-") as scratch:
        path = Path(scratch) / f"{each.graph}.onnx"
        model = load(bundle.file(manifest.graphs[each.graph].file))
        save(model, path)
        if cut_phases(model) is None:
            note = "the network itself computes the phase, so that it cannot be cut out"
        program, parted = part_phases(manifest.program, each.graph, path)
        if not parted:
            note = note or "the graph runs in a loop, which a program cannot share between two graphs"
        try:
            plain = _actions(bundle, {}, observations, dict.fromkeys(manifest.graphs, ""))
            now = _actions(bundle, {}, observations, {})
            replaced = {each.graph: path, **{name: path.with_name(f"{name}.onnx") for name in parted}}
            cut = _actions(bundle, replaced, observations, {}, program) if parted else []
        except VlatoolError as error:
            return replace(each, note=f"not measured: {error.message}")
    return replace(each, error=_error(now, plain), cut=_error(cut, plain) if cut else float("nan"), note=note)


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
    found = []
    for observation in observations:
        policy.reset()
        found.append(np.array(policy.infer(observation).outputs[manifest.spec.action.name]))
    return found


def _error(got: Sequence[Any], wanted: Sequence[Any]) -> float:
    return float(np.mean([relative_error(*pair) for pair in zip(got, wanted, strict=True)]))


def told(found: Sequence[Phases], again: str) -> list[str]:
    """Return the sentences for a reader, the bad news first.

    Args:
        found: From ``phases``.
        again: The command that makes the bundle again.
    """
    sentences = []
    for each in sorted(found, key=lambda item: not item.nodes):
        if each.kept:
            text = f"The phases of {each.graph} stay in float32, in the graph {each.kept}: {REASON}."
            if not each.nodes and each.error == each.error:
                text += f" Measured: relative error {each.cut:.3g}; it would be {each.error:.3g} all in bfloat16."
            sentences.append(text)
        if each.nodes:
            sentences.append(_ruined(each, again))
    return sentences


def _ruined(each: Phases, again: str) -> str:
    nodes = ", ".join(each.nodes[:3]) + (f" and {len(each.nodes) - 3} more" if len(each.nodes) > 3 else "")
    text = f"{each.graph} computes {nodes} of its inputs in bfloat16, which ruins such phases: {REASON}."
    if each.error == each.error:
        text += f" Measured: relative error {each.error:.3g} now"
        text += f", {each.cut:.3g} with the phases in float32" if each.cut == each.cut else ""
        text += "."
    if each.note:
        text += f" {each.note[0].upper()}{each.note[1:]}."
    elif each.cut < each.error:
        text += f" Make it again: {again}"
    return text
