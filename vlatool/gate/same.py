"""Check that two bundles are versions of one policy: only those can be held against each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.module_bundle import no_graph_error
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import BundleError, DataError, GraphError, fix_for, require, suggest
from vlatool.gate.config import Gate
from vlatool.graph.files import read
from vlatool.graph.random_ops import random_operators

MEANING = ("shape", "dtype", "kind", "unit", "labels", "mode", "max_tokens", "finite", "frame", "history")
"""Fields that a robot relies on; files of statistics and tokenizers may differ."""
RATE = {"control_hz": "control_hz", "chunk": "chunk", "executed": "executed_actions"}
"""Name of a rate in messages -> field or property of the spec."""
FEWER_STEPS = "prune.steps"
ACCURACY = "accuracy"
"""The claim that alone says what steps are worth."""
LARGEST_TOLERANCE = 1.0
"""Largest tolerance of a golden action: with more, ``load`` would accept any."""


def check(candidate: Bundle, baseline: Bundle, gate: Gate) -> None:
    """Refuse what cannot be compared, before anything is measured.

    Raises:
        BundleError: when a bundle has no graph or lacks the baseline's golden action, or the two have other inputs or
            outputs, another rate, or keep, draw or repeat something else, or are played in other environments.
        GraphError: when a graph draws random numbers of its own, or its weights cannot be read.
        DataError: when accuracy is claimed and there is nothing to measure it on, or steps that a stage left out are
            not covered by that claim.
    """
    for bundle in (candidate, baseline):
        if not bundle.manifest.graphs:
            raise no_graph_error(bundle, "run")
        engine, known = bundle.manifest.engine, registry.names("engines")
        if engine and engine not in known:
            raise BundleError(
                f"{bundle.path} is made for the engine '{engine}'; {suggest(engine, known)}.", fix_for(engine, known)
            )
    mine, theirs = candidate.manifest, baseline.manifest
    rates = [(name, getattr(mine.spec, of), getattr(theirs.spec, of)) for name, of in RATE.items()]
    differs = _tensors(mine, theirs) or _differences(rates) or _program(mine, theirs)
    if gate.plan.episodes and gate.plan.policy is None:  # they are played in what the bundles name
        differs = differs or _scene(mine, theirs)
    if differs:
        raise BundleError(
            f"{candidate.path} and {baseline.path} are not versions of one policy: {differs}.",
            "name a candidate and a baseline that were made from the same policy",
        )
    _check_golden(candidate, baseline)
    if _has_fewer_steps(mine, theirs) and ACCURACY not in gate.claims:
        raise DataError(
            f"{candidate.path} runs fewer steps than the baseline, and no claim is made of its accuracy.",
            "claim it in the gate (accuracy: {data: FILE} or {episodes: N}): it alone says what the steps are worth",
        )
    for bundle in (candidate, baseline):
        _refuse_draws(bundle)
    for claim in gate.claims.values():
        claim.check(baseline, gate.plan)


def _scene(mine: Manifest, theirs: Manifest) -> str:
    """Return in words how the environment that the candidate names differs from the baseline's, which is played.

    One that names none lets the baseline's stand.
    """
    if not mine.environment:
        return ""
    keys = [key for key in dict.fromkeys((*theirs.environment, *mine.environment)) if key != "timeout"]
    pairs = [(key, mine.environment.get(key), theirs.environment.get(key)) for key in keys]
    return _differences(pairs, "environment: ")


def _check_golden(candidate: Bundle, baseline: Bundle) -> None:
    """Refuse a candidate whose golden action a robot could not check as it checks the baseline's."""
    mine = candidate.manifest
    if baseline.manifest.golden and not mine.golden:
        raise BundleError(f"{candidate.path} has no golden action, which the baseline has.", "make the bundle again")
    if (allowed := max(mine.golden_tolerance, mine.golden_chunk_tolerance)) > LARGEST_TOLERANCE:
        raise BundleError(
            f"{candidate.path} lets its golden action differ by {allowed:g}, so that load accepts any action; allowed: "
            f"up to {LARGEST_TOLERANCE:g}.",
            "make the bundle again",
        )


def _refuse_draws(bundle: Bundle) -> None:
    """Refuse graphs that draw random numbers: no two runs can be held against each other, and draws count calls."""
    require("onnx", "build")
    from google.protobuf.message import DecodeError

    for name, graph in bundle.manifest.graphs.items():
        file = bundle.path / graph.file
        try:
            operators = random_operators(read(file, weights=False))
        except DecodeError as error:
            raise GraphError(f"{file} cannot be read as an ONNX file: {error}.", "make the bundle again") from error
        if operators:
            raise GraphError(
                f"The graph '{name}' of {bundle.path} draws random numbers ({', '.join(operators)}): what it answers "
                "at one call says nothing about the next.",
                "declare the noise in the program of policy.yaml, and make the bundle again with vlatool; "
                "export refuses such graphs, too",
            )


def _tensors(mine: Manifest, theirs: Manifest) -> str:
    for kind in ("inputs", "outputs"):
        one, two = ({tensor.name: tensor for tensor in getattr(manifest.spec, kind)} for manifest in (mine, theirs))
        for name in {**two, **one}:
            if differs := _differs(one.get(name), two.get(name)):
                return f"{kind[:-1]} {name}: {differs}"
    return _differences([("the action", mine.spec.action.name, theirs.spec.action.name)])


def _differs(mine: TensorSpec | None, theirs: TensorSpec | None) -> str:
    """Return in words how an input or output of the candidate differs from the baseline's; nothing when it does not."""
    if mine is None or theirs is None:
        return f"it is in the {'baseline' if mine is None else 'candidate'} alone"
    return _differences([(name, getattr(mine, name), getattr(theirs, name)) for name in MEANING])


def _program(mine: Manifest, theirs: Manifest) -> str:
    """Return what the candidate keeps between inferences, draws, or repeats otherwise than the baseline.

    How a program is cut into graphs is each bundle's own business; that it has fewer steps is, where it was made so:
    success tells what that is worth.
    """
    words = ("keep", "noise") if _has_fewer_steps(mine, theirs) else ("keep", "noise", "schedule")
    parts: list[tuple[str, Any, Any]] = [(word, _of_all(mine, word), _of_all(theirs, word)) for word in words]
    if not _has_fewer_steps(mine, theirs):
        parts.append(("repeat", _repeat(mine), _repeat(theirs)))
    return _differences(parts, "the program's ")


def _has_fewer_steps(mine: Manifest, theirs: Manifest) -> bool:
    """Return whether a stage reduced the steps of the candidate's program, and it differs in that alone."""
    reduced = any(entry.get("stage") == FEWER_STEPS for entry in mine.build)
    same_names = set(_of_all(mine, "schedule")) == set(_of_all(theirs, "schedule"))
    return reduced and same_names and _repeat(mine) < _repeat(theirs)


def _repeat(manifest: Manifest) -> int:
    """Return how often the graph that runs most often runs in an inference."""
    return max(step.repeat for step in manifest.program)


def _of_all(manifest: Manifest, word: str) -> dict[str, Any]:
    return {name: value for step in manifest.program for name, value in getattr(step, word).items()}


def _differences(values: Sequence[tuple[str, Any, Any]], about: str = "") -> str:
    """Return in words which values differ: name, the candidate's, the baseline's."""
    listed = ((name, *(list(each) if isinstance(each, tuple) else each for each in pair)) for name, *pair in values)
    return "; ".join(f"{about}{name} {mine!r} in the candidate, {theirs!r} in the baseline"
                     for name, mine, theirs in listed if mine != theirs)  # fmt: skip
