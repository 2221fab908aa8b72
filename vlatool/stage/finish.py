"""The last steps of every stage that writes a bundle: copied folders, golden inputs and outputs, hashes."""

from __future__ import annotations

import contextlib
import json
import math
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import REPORTS, Bundle, replace_manifest, seal
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.files.blob_store import link_or_copy
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.arithmetic import SATURATING, int8_trouble, is_int8, machine
from vlatool.runtime.contract import OF_NOT_FINITE, OF_THE_GRAPHS, OF_THE_POLICY, off_the_robot
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class, identities
from vlatool.runtime.engines import reference
from vlatool.runtime.golden import CHUNK, ROBOT_CHUNK
from vlatool.runtime.graph_files import open_graph
from vlatool.runtime.interface import Action
from vlatool.runtime.observation import not_finite_text
from vlatool.runtime.policy import Policy, relative_error
from vlatool.runtime.program import Program, draw

GOLDEN = "golden/golden.npz"
GOLDEN_COUNT = 2
ENGINE_DIFFERENCE = "engine-difference"
INEXACT = "inexact-reference"
MAX_ROUNDING = 0.045
"""Relative L2 difference of an engine from what the graph says, up to which it is rounding that falls the other way. On
right engines and processors it was seen to be at most 0.035, on wrong ones at least 0.09, and where int8 products
saturate from 0.045 on."""
ROUNDING_OF_ONE = 2.0**-22
"""Differences up to which an action is the same: two roundings of a float32 near 1, which is what a sigmoid or a
softmax computes with. Where it answers a millionth everywhere, these are a large part of the answer, and mean nothing:
the detector of PP-OCRv4 on pictures of noise differs by 1e-7, a quarter of its largest probability."""
MAX_DISTANCE_RATIO = 1.2
"""Largest ratio of the distance of an engine that rounds differently to that of the graphs, both from the source: root
mean square of ``MAX_COMPARED`` observations: the engine draws an error of the same size again. A loop over int8 layers
carries a rounding that falls the other way into all that follow: in ten steps of a denoising UNet the engine was as far
from the graphs (up to 0.09) as either was from float32. Of its observations 99 in 100 choices of 8 give at most 1.18; a
fault of the engine beside the rounding, at least as large as it, gives 1.41."""
MAX_COMPARED = 32
"""Observations on which a new bundle is held against the one that it was made from, and how many a stage should give
``finish``: what an engine does wrong, products that saturate for instance, may show in one of ten."""
MIN_COMPARED = 8
"""How many times observations are looked at where fewer are given, each with other noise."""
DIFFERENCE = f"{REPORTS}/difference.json"
REDRAWN_FACTOR = 1.5
"""How many times that difference is allowed on other machines, where it is drawn again: of 18 observations, the largest
was up to 1.44 times what two of them showed, but for one choice of two in twenty."""
LEAST_TOLERANCE = 0.01
COARSE_TOLERANCE = {"int8": 0.02, "float16": 0.03, "int4": 0.03, "int4 weights": 0.03, "float8": 0.06}
"""The same for graphs whose kernels round differently by design from processor to processor: float16 is computed as
such where there is arithmetic for it and in float32 elsewhere, the activations beside int4 weights are rounded to int8
where there is a dot product. Golden actions of the samples differed by 0.013 (Cortex-A76) and 0.009 (Cortex-A72). A sum
that is added up in another order falls on the other side of a step of float8, which is an eighth of a value: between
one and two threads of ONNX Runtime 1.32 the action of a ResNet-18 with a GRU differed by 0.029. An engine that rounds
int8 as the graphs say where a bundle is made need not do so elsewhere: ten steps of a flow differed by 0.0123 between
the kernels of AVX and of AVX2."""
SEED = 0
"""Seed of the noise that golden inputs and calibration runs draw."""
CARRIED_FOLDERS = ("assets", "data")
OPTIMIZE = "optimize"
"""In a build record, the entry of the step in which ``optimize`` finalizes a candidate."""
FINALIZED_FIELDS = ("accuracy", "engine")
"""Fields of a manifest that ``optimize`` sets when it finalizes a candidate."""


@dataclass(frozen=True)
class Golden:
    """What the golden file was written from.

    Args:
        samples: observations with the noise of each.
        expected: what the graphs say.
        difference: largest relative L2 difference of the engine's actions from those of the graphs, as they give them.
        of_chunk: the same of the chunks in physical units.
        largest: largest difference of an element of the actions, in their own unit.
    """

    samples: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]
    expected: Sequence[Action]
    difference: float
    of_chunk: float
    largest: float = math.inf


@dataclass(frozen=True)
class Difference:
    """How far the actions that an engine gives are from those of the graphs that a bundle was made from.

    Args:
        mean, worst: mean and maximum of the relative L2 differences of an output; the share of others if discrete.
        recorded: whether they were recorded.
    """

    mean: float
    worst: float
    samples: int
    recorded: bool


def carry_over(source: Bundle, out: Path, folders: Iterable[str] = CARRIED_FOLDERS) -> None:
    """Copy the folders that a derived bundle keeps; large files are shared among the stages of a cache."""
    known = source.manifest.files
    for folder in folders:
        for file in sorted((source.path / folder).rglob("*")):
            if file.is_file():
                target = out / file.relative_to(source.path)
                name = file.relative_to(source.path).as_posix()
                target.parent.mkdir(parents=True, exist_ok=True)
                link_or_copy(file, target, known[name].sha256 if name in known else "")


def finish(
    source: Bundle,
    out: Path,
    *,
    made_by: Mapping[str, Any],
    graphs: Mapping[str, Graph],
    observations: list[dict[str, Any]],
    changes: Mapping[str, Any] | None = None,
    recorded: bool = False,
) -> Bundle:
    """Write golden file and manifest of a bundle whose graphs and carried folders are in ``out`` already.

    Args:
        graphs: graph name -> graph.
        observations: raw observations; the first two become golden. On ``MAX_COMPARED`` of them the bundle is compared
            with the source, where that has graphs.
        changes: other fields of the manifest that the stage changes, such as program and engine.
        recorded: whether the observations were recorded.

    Raises:
        GraphError: when the engine refuses a graph or gives an action that is not finite.
    """
    changed: dict[str, Any] = {"parent": source.hash, "graphs": dict(graphs), "accuracy": {}, **(changes or {})}
    changed["made_by"] = _with_engine(made_by, changed.get("engine", source.manifest.engine))
    origin = {key: value for key, value in source.manifest.source.items() if key != "arguments"}
    unhashed = {graph.file: FileRecord("", 0) for graph in graphs.values()}
    draft = seal(out, replace(source.manifest, golden="", source=origin, files=unhashed, **changed))
    golden = write_golden(draft, observations, out)
    build = (*history(source), _step(source, draft.manifest))
    bundle = seal(out, replace(draft.manifest, golden=GOLDEN, build=build))
    held = _EngineCheck(source, bundle, observations) if source.manifest.graphs else None
    if held is not None:
        held.write(out / DIFFERENCE, recorded)
    difference, limit, redrawn = _judge_engine(bundle, golden, held)
    new = [] if difference <= limit or redrawn else [_engine_difference(bundle, difference, limit)]
    if is_int8(bundle.manifest) and reference().arithmetic() == SATURATING:
        new.append(_inexact_reference(bundle))
    kept = [finding for finding in source.manifest.findings if finding["name"] not in (ENGINE_DIFFERENCE, INEXACT)]
    discrete = bundle.manifest.spec.action.kind == "discrete"
    return replace_manifest(bundle, replace(
        bundle.manifest, findings=(*kept, *new), golden_tolerance=_tolerance(golden.difference, bundle, redrawn),
        golden_chunk_tolerance=0.0 if discrete else _tolerance(golden.of_chunk, bundle, redrawn),
    ))  # fmt: skip


def _with_engine(made_by: Mapping[str, Any], engine: str) -> dict[str, Any]:
    """Return ``made_by`` with the identity of the bundle's engine among the versions, where it has one."""
    built = identities().get(engine)
    return {**made_by, "versions": {**made_by.get("versions", {}), engine: built}} if built else dict(made_by)


def _tolerance(seen: float, bundle: Bundle, redrawn: bool) -> float:
    """Return what a machine may differ where the engine was seen to differ so much, in three decimals; at most 1.

    What differs in rounding here may do so twice as much elsewhere; a larger difference is not rounding, or one that is
    drawn again on each machine.
    """
    computed = {name for graph in bundle.manifest.graphs.values() for name in graph.precision}
    least = max([LEAST_TOLERANCE, *(COARSE_TOLERANCE[name] for name in computed & set(COARSE_TOLERANCE))])
    tolerance = max(least, (REDRAWN_FACTOR if redrawn else 1.2) * seen, min(2 * seen, MAX_ROUNDING))
    return math.ceil(tolerance * 1000) / 1000 if math.isfinite(tolerance) else 1.0


class _EngineCheck:
    """What the engine of a bundle gives for observations, beside what the graphs say that it was made from.

    Args:
        source, bundle: both with graphs.
        observations: raw ones, at least one.
    """

    def __init__(self, source: Bundle, bundle: Bundle, observations: Sequence[Mapping[str, Any]]) -> None:
        count = max(MIN_COMPARED, min(MAX_COMPARED, len(observations)))
        self._bundle, self._name = bundle, bundle.manifest.spec.action.name
        self._samples = _samples(bundle.manifest, observations, count)
        self._before = _outputs(reference_policy(source), self._samples)
        policy = Policy.open(bundle, threads=1, seed=SEED)
        self._own = _outputs(policy, self._samples, engine_class(policy.engine))
        self.errors = _differences(self._own, self._before, self._name)

    def against_graphs(self) -> tuple[list[float], list[float]]:
        """Return how far the engine is from what the bundle's graphs say, and how far these are from the source's."""
        graphs = _outputs(reference_policy(self._bundle), self._samples)
        return _differences(self._own, graphs, self._name), _differences(graphs, self._before, self._name)

    def write(self, path: Path, recorded: bool) -> None:
        """Write a ``Difference`` as JSON."""
        errors = self.errors
        if self._bundle.manifest.spec.action.kind == "discrete":  # the output may be logits
            pairs = zip(self._own, self._before, strict=True)
            errors = [float(not np.array_equal(one.chunk, other.chunk)) for one, other in pairs]
        worst = _worst(errors)
        mean = float(np.mean(errors)) if math.isfinite(worst) else math.inf
        path.parent.mkdir(exist_ok=True)
        values = {"mean": mean, "worst": worst, "samples": len(errors), "recorded": recorded}
        path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def read_difference(bundle: Bundle) -> Difference | None:
    """Return what ``finish`` saw of a bundle; None where there was nothing to hold it against."""
    path = bundle.path / DIFFERENCE
    return Difference(**json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None


def _judge_engine(bundle: Bundle, golden: Golden, held: _EngineCheck | None) -> tuple[float, float, bool]:
    """Return how far the engine is from what the graphs say, how far it may be, and whether it only rounds otherwise.

    It may be as far as the graphs are from those of the source. It rounds otherwise where it is as near to the source
    as they are: then it computes the same policy, and no other one. What is computed in bfloat16 differs by what
    bfloat16 costs, which is judged as accuracy.
    """
    computes = {graph.compute for graph in bundle.manifest.graphs.values()}
    if "bfloat16" in computes or (held is None and golden.largest <= ROUNDING_OF_ONE):
        return golden.difference, math.inf, False
    if held is None or max(golden.difference, _worst(held.errors)) <= MAX_ROUNDING:
        return golden.difference, MAX_ROUNDING, False
    engine, graphs = held.against_graphs()
    difference, limit = max(golden.difference, _worst(engine)), max(MAX_ROUNDING, _worst(graphs))
    near = float(np.linalg.norm(held.errors)) <= MAX_DISTANCE_RATIO * float(np.linalg.norm(graphs)) < math.inf
    return difference, limit, difference > limit and near


def _samples(
    manifest: Manifest, observations: Sequence[Mapping[str, Any]], count: int
) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Return ``count`` observations, starting over where there are fewer, with noise for each."""
    random = np.random.default_rng(SEED)
    noises = [pair for step in manifest.program for pair in step.noise.items()]
    chosen = [observations[index % len(observations)] for index in range(count)]
    return [(observation, {name: draw(noise, random) for name, noise in noises}) for observation in chosen]


def _differences(actions: Sequence[Action], expected: Sequence[Action], name: str) -> list[float]:
    """Return the relative L2 difference of an output, for each action."""
    return [relative_error(a.outputs[name], b.outputs[name]) for a, b in zip(actions, expected, strict=True)]


def _engine_difference(bundle: Bundle, difference: float, limit: float) -> dict[str, Any]:
    engine = bundle.manifest.engine or DEFAULT_ENGINE
    words = f"the engine {engine} computes another action than the graphs say on this {machine(engine)}: relative "
    words += f"difference {difference:.2g}, allowed {limit:.2g}. Do not trust this bundle; "
    cause, remedy = int8_trouble(bundle.manifest, engine)
    words += remedy or "leave layers out with --exclude, or use another layout or engine"
    words += f". {cause}".rstrip()
    value = round(difference, 4) if math.isfinite(difference) else 1e9
    stage = str(bundle.manifest.made_by.get("stage", ""))
    return {"name": ENGINE_DIFFERENCE, "message": words, "value": value, "allowed": round(limit, 4), "stage": stage}


def _inexact_reference(bundle: Bundle) -> dict[str, Any]:
    words = "the golden action of this bundle was computed where int8 products are not exact, with any option of ONNX "
    words += "Runtime that was tried: it may be another one than the graphs say. Make the bundle on another machine."
    return {"name": INEXACT, "message": words, "stage": str(bundle.manifest.made_by.get("stage", ""))}


def history(bundle: Bundle) -> tuple[dict[str, Any], ...]:
    """Return the build record of a bundle: one entry for each stage from the source to this bundle.

    A source bundle has no ``build`` of its own, and ``optimize`` finalizes a bundle without a stage; their entries are
    what their manifests say. A bundle from before there was a record has an incomplete one, or none.
    """
    manifest = bundle.manifest
    made_by, recorded = manifest.made_by, manifest.build
    if not recorded and str(made_by.get("stage", "")).startswith("sources."):
        recorded = ({**made_by, "factory": manifest.source.get("factory", "")},)
    if "candidate" not in made_by or (recorded and recorded[-1]["stage"] == OPTIMIZE):
        return recorded
    options = {name: made_by[name] for name in ("candidate", "profile") if name in made_by}
    handed = {"vlatool": made_by.get("vlatool", ""), "stage": OPTIMIZE, "options": options, "input": manifest.parent}
    decided = {name: getattr(manifest, name) for name in FINALIZED_FIELDS if getattr(manifest, name)}
    return (*recorded, {**handed, **decided})


def _step(source: Bundle, draft: Manifest) -> dict[str, Any]:
    """Return the entry of the stage that made ``draft`` from ``source``."""
    starts = str(draft.made_by.get("stage", "")).startswith("sources.")
    graphs = {name: record.sha256 for name, record in draft.files.items() if name.startswith("graphs/")}
    seed = draft.made_by.get("seed", SEED)
    return {**draft.made_by, "seed": seed, "input": "" if starts else source.hash, "graphs": graphs}


def reseal(bundle: Bundle, out: Path, manifest: Manifest, folders: Iterable[str]) -> Bundle:
    """Copy folders of a bundle to ``out`` and seal it there under another manifest."""
    carry_over(bundle, out, folders)
    return seal(out, manifest)


def write_golden(draft: Bundle, observations: list[dict[str, Any]], out: Path) -> Golden:
    """Run the first observations and store ``in.NAME``, ``noise.NAME``, ``out.NAME`` and ``chunk.NAME``.

    Each has a sample axis. The outputs are what the graphs say: the engine that the bundle is made for may compute
    something else. The samples follow each other without a reset between, so that what a program keeps shows in the
    second. The chunk is the action in physical units, before it is converted: it shows other statistics, too. What the
    conversion makes of it is ``robot_chunk.NAME``.

    Args:
        draft: the bundle as written so far; its graphs are what runs.
        observations: raw observations without the batch axis.
        out: the bundle's directory.
    """
    samples = _samples(draft.manifest, observations, GOLDEN_COUNT)
    name = draft.manifest.spec.action.name
    # closed before the engine opens: one set of weights at a time
    expected = _outputs(reference_policy(draft), samples, reference())
    policy = Policy.open(draft, threads=1, seed=SEED)
    own = _outputs(policy, samples, engine_class(policy.engine))
    arrays: dict[str, list[Any]] = {}
    for (observation, noise), action in zip(samples, expected, strict=True):
        parts = (
            ("in", observation),
            ("noise", noise),
            ("out", action.outputs),
            (CHUNK, {name: policy.golden_chunk(action)}),
            (ROBOT_CHUNK, {name: action.chunk}),
        )
        for prefix, values in parts:
            for key, value in values.items():
                arrays.setdefault(f"{prefix}.{key}", []).append(value)
    (out / GOLDEN).parent.mkdir(exist_ok=True)
    save_npz(out / GOLDEN, {key: np.stack([np.asarray(item) for item in items]) for key, items in arrays.items()})
    of_chunk = _worst(policy.golden_difference(a, policy.golden_chunk(b)) for a, b in zip(own, expected, strict=True))
    largest = _worst(_largest(a.outputs[name], b.outputs[name]) for a, b in zip(own, expected, strict=True))
    return Golden(samples, expected, _worst(_differences(own, expected, name)), of_chunk, largest)


def _largest(got: Any, expected: Any) -> float:
    """Return the largest difference of an element; infinite for another shape."""
    one, other = np.asarray(got, np.float64), np.asarray(expected, np.float64)
    return float(np.max(np.abs(one - other), initial=0.0)) if one.shape == other.shape else math.inf


def _worst(errors: Iterable[float]) -> float:
    return max((error if error == error else math.inf for error in errors), default=0.0)


def _outputs(
    policy: Policy, samples: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]], engine: Any = None
) -> list[Action]:
    """Return the action of each observation; ``engine`` is told where it runs these graphs for the first time."""
    policy.reset()
    actions = []
    fix = OF_THE_GRAPHS if policy.bundle.manifest.parent else OF_THE_POLICY
    for number, (observation, noise) in enumerate(samples):
        deed = f"ran {graph_names(policy.bundle.manifest)}"
        doing = engine_call(engine, deed) if engine else contextlib.nullcontext()
        held = not_finite_text(policy.spec, observation)
        remedy = OF_NOT_FINITE if held and not policy.bundle.manifest.parent else fix
        with doing, off_the_robot(f"observation {number}{f', which holds {held}' if held else ''}", remedy):
            actions.append(policy.infer(observation, noise=noise))
    return actions


def graph_names(manifest: Manifest) -> str:
    """Return the graphs of a bundle in words."""
    names = " and ".join(f"'{name}'" for name in manifest.graphs)
    return f"the graph{'s' if len(manifest.graphs) > 1 else ''} {names}"


def reference_policy(bundle: Bundle) -> Policy:
    """Open a bundle in the reference engine, which computes graphs as written, whatever engine it was made for."""
    graphs = bundle.manifest.graphs.items()
    sessions = {name: open_graph(bundle, replace(graph, compute=""), reference(), 1) for name, graph in graphs}
    return Policy(bundle, Program(bundle.manifest.program, sessions, SEED), "reference")


def save_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as ``.npz`` with fixed time stamps, so that equal arrays give equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
