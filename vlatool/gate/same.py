"""Whether two bundles are versions of one policy: only those can be held against each other."""

from __future__ import annotations

from typing import Any

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import TensorSpec
from vlatool.bundle.unexported import no_graph
from vlatool.errors import BundleError, GraphError, nearest, require
from vlatool.gate.claims import accuracy
from vlatool.gate.config import Gate
from vlatool.graph.draws import drawing
from vlatool.graph.files import read

MEANING = ("shape", "dtype", "kind", "unit", "labels", "mode")
"""What a robot relies on; files of statistics and tokenizers may differ."""
RATE = ("control_hz", "chunk", "execute")
FEWER_STEPS = "prune.steps"


def check(candidate: Bundle, baseline: Bundle, gate: Gate) -> None:
    """Say before anything is measured why it cannot be.

    Raises:
        BundleError: when a bundle has no graph or lacks the baseline's golden action, or the two have other inputs or
            outputs, another rate, or keep, draw or repeat something else.
        GraphError: when a graph draws random numbers of its own, or its weights cannot be read.
        DataError: when accuracy is claimed and there is nothing to measure it on.
    """
    for bundle in (candidate, baseline):
        if not bundle.manifest.graphs:
            raise no_graph(bundle, "run")
        engine, known = bundle.manifest.engine, registry.names("engines")
        if engine and engine not in known:
            raise BundleError(f"{bundle.path} is made for the engine '{engine}'; {nearest(engine, known)}.")
    mine, theirs = candidate.manifest, baseline.manifest
    if differs := _tensors(mine, theirs) or _rates(mine, theirs) or _program(mine, theirs):
        raise BundleError(f"{candidate.path} and {baseline.path} are no versions of one policy: {differs}.")
    if theirs.golden and not mine.golden:
        raise BundleError(f"{candidate.path} has no golden action, which the baseline has.", "make the bundle again")
    for bundle in (candidate, baseline):
        _refuse_draws(bundle)
    if gate.accuracy:
        accuracy.data_of(baseline, gate.accuracy)


def _refuse_draws(bundle: Bundle) -> None:
    """Refuse graphs that draw random numbers: no two runs can be held against each other, and draws count calls."""
    require("onnx", "build")
    from google.protobuf.message import DecodeError

    for name, graph in bundle.manifest.graphs.items():
        file = bundle.path / graph.file
        try:
            operators = drawing(read(file, weights=False))
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
    return _told("the action", mine.spec.action.name, theirs.spec.action.name)


def _differs(mine: TensorSpec | None, theirs: TensorSpec | None) -> str:
    """Return in words how an input or output of the candidate differs from the baseline's; nothing when it does not."""
    if mine is None or theirs is None:
        return f"it is in the {'baseline' if mine is None else 'candidate'} alone"
    pairs = [(name, getattr(mine, name), getattr(theirs, name)) for name in MEANING]
    return "; ".join(text for name, one, two in pairs if (text := _told(name, one, two)))


def _rates(mine: Manifest, theirs: Manifest) -> str:
    pairs = [(name, getattr(mine.spec, name), getattr(theirs.spec, name)) for name in RATE]
    return "; ".join(text for name, one, two in pairs if (text := _told(name, one, two)))


def _program(mine: Manifest, theirs: Manifest) -> str:
    """Return what the candidate keeps between inferences, draws, or repeats otherwise than the baseline.

    How a program is cut into graphs is each bundle's own business; that it has fewer steps is, where it was made so:
    success tells what that is worth.
    """
    words = ("keep", "noise") if _has_fewer_steps(mine, theirs) else ("keep", "noise", "schedule")
    parts: list[tuple[str, Any, Any]] = [(word, _of_all(mine, word), _of_all(theirs, word)) for word in words]
    if not _has_fewer_steps(mine, theirs):
        parts.append(("repeat", _repeat(mine), _repeat(theirs)))
    return "; ".join(text for word, one, two in parts if (text := _told(f"the program's {word}", one, two)))


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


def _told(name: str, mine: Any, theirs: Any) -> str:
    if mine == theirs:
        return ""
    one, two = (list(value) if isinstance(value, tuple) else value for value in (mine, theirs))
    return f"{name} {one!r} in the candidate, {two!r} in the baseline"
