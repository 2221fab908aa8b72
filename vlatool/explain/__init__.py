"""Why a bundle is as accurate and as fast as it is: the layers, the operators, the limit, and what to do about it."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import BundleError, VlatoolError
from vlatool.explain import _tables as tables
from vlatool.explain._bfloat16 import Phases, phases, told
from vlatool.explain._islands import Fallback, Island, QuantizedGraph, fallbacks, timed
from vlatool.explain._operators import Operator, profile, reference_engine, table
from vlatool.explain._origin import (
    Observations,
    Origin,
    command,
    find_baseline,
    observations_of,
    origin,
    sensitivity_stage,
)
from vlatool.explain._remedy import measure, plans
from vlatool.graph.workload import workload
from vlatool.machine.host import fingerprint
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.report import Report, Row
from vlatool.runtime.engine import DEFAULT_ENGINE
from vlatool.sensitivity.layers import LayerError, ranges_of, sensitivities
from vlatool.stage.base import Context

__all__ = ["Options", "explain", "explanation"]


@dataclass(frozen=True)
class Options:
    """What an explanation is made of.

    Args:
        baseline: The float32 bundle; looked for in the cache when None.
        data: Recorded observations that errors are taken on; the bundle's own when None.
        samples: Observations at most.
        runs: Inferences that the operators are timed over.
        threads: Intra-op threads.
        suggest: Make and measure candidates.
        seconds: The layers are measured on fewer observations when all would take longer.
    """

    baseline: Path | None = None
    data: Path | None = None
    samples: int = 16
    runs: int = 20
    threads: int = 1
    suggest: bool = True
    seconds: float = 300.0


@dataclass
class _Found:
    """What was found out about a bundle."""

    bundle: Bundle
    baseline: Bundle | None
    made: Origin
    seen: Observations
    layers: list[LayerError] = field(default_factory=list)
    operators: list[Operator] = field(default_factory=list)
    before: list[Operator] = field(default_factory=list)
    islands: list[Island] = field(default_factory=list)
    pairs: tuple[int, int] = (0, 0)
    fallen: list[Fallback] = field(default_factory=list)
    phases: list[Phases] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def source(self) -> str:
        """The float32 bundle as it is written in a command."""
        return str(self.baseline.path) if self.baseline is not None else "FLOAT_BUNDLE"


def explain(bundle: Bundle, options: Options, context: Context) -> Report:
    """Return the report that explains accuracy and speed of a bundle.

    Raises:
        BundleError: when the bundle has no graph, or the given baseline is another policy's.
        DataError: when the given data does not fit.
        GraphError: when a graph cannot be run.
    """
    host = fingerprint()
    found = _find(bundle, options, context)
    with tempfile.TemporaryDirectory(prefix="vlatool-") as scratch:
        engine = bundle.manifest.engine or DEFAULT_ENGINE
        wanted = options.suggest and found.baseline is not None and found.seen.recorded
        tried = plans(found.made.stage, found.layers, found.fallen, engine) if wanted else []
        values = found.seen.values
        contest = measure(bundle, found.baseline, tried, values, Path(scratch), options.threads, context)
        sentences = _sentences(found, contest.speed)
        sentences[1:1] = tables.suggested(contest, found.source)
        sentences += tables.tried_told(contest, found.layers)
        found.warnings += [f"the candidate '{each.name}' failed: {each.failed}" for each in tried if each.failed]
        details = _details(found)
        rows: list[Row] = []
        for each in (contest.baseline, contest.now, *contest.others):
            if each is not None:
                own = details if each is contest.now else {}
                rows.append(tables.candidate_row(each, contest, own, found.source))
    name = str(bundle.manifest.made_by.get("stage", "")).rpartition(".")[2]
    rows = [replace(row, name=name or row.name) if row.name == "as it is" else row for row in rows]
    title = f"Why {bundle.manifest.name} ({name or 'as it is'}) is as accurate and as fast as it is"
    return Report(
        "explain", title, summary=tuple(sentences), rows=tuple(rows), environment=host, warnings=tuple(found.warnings)
    )


def explanation(
    bundle: Bundle,
    baseline: Bundle | None,
    context: Context,
    *,
    samples: int = 8,
    runs: int = 10,
    seconds: float = 60.0,
) -> tuple[str, ...]:
    """Return the explanation as a few sentences, for another report. What cannot be found out is left out.

    Args:
        bundle: What is explained.
        baseline: The float32 bundle that it was made from.
        context: For progress.
        samples: Observations that the layers are measured on.
        runs: Inferences that the operators are timed over.
        seconds: The layers are measured on fewer observations when all would take longer, on one at least.
    """
    try:
        options = Options(baseline.path if baseline is not None else None, samples=samples, runs=runs, seconds=seconds)
        return tuple(_sentences(_find(bundle, options, context)))
    except VlatoolError as error:
        return (f"This could not be explained: {error.message}",)


def _find(bundle: Bundle, options: Options, context: Context) -> _Found:
    if not bundle.manifest.graphs:
        raise BundleError(f"{bundle.path} has no graph to explain.", "export it first: vlatool export SOURCE -o BUNDLE")
    made = origin(bundle)
    baseline = find_baseline(bundle, made, options.baseline)
    seen = observations_of(bundle, baseline, options.data, options.samples)
    found = _Found(bundle, baseline, made, seen, warnings=list(made.notes))
    if not seen.recorded:
        found.warnings.append("there are no recorded observations: the layers' errors are not measured (--data FILE)")
    _layers(found, options.seconds, context)
    _times(found, options, context)
    found.phases = phases(bundle, baseline, seen.values, context)
    return found


def _layers(found: _Found, seconds: float, context: Context) -> None:
    """Measure each layer alone in int8."""
    stage = sensitivity_stage(found.made.stage)
    if stage is None or not found.seen.recorded:
        return
    if found.baseline is None:
        found.warnings.append(
            "the float32 bundle that this one was made from is not in the cache, so no layer could be measured: "
            f"vlatool explain {found.bundle.path} --baseline FLOAT_BUNDLE"
        )
        return
    try:
        static = isinstance(found.made.stage, StaticInt8)
        ranges = ranges_of(found.baseline, stage, context) if static else {}
        found.layers = sensitivities(found.baseline, stage, ranges, found.seen.values, context, seconds=seconds)
    except VlatoolError as error:
        found.warnings.append(f"the layers could not be measured: {error.message} {error.fix}".strip())


def _times(found: _Found, options: Options, context: Context) -> None:
    """Profile the bundle and the float32 one, and look at the quantized graphs."""
    values = found.seen.values
    context.tell("profiling the operators", None)
    found.operators = profile(found.bundle, values, options.runs, options.threads)
    if found.baseline is not None:
        context.tell("profiling the operators of float32", None)
        compared = reference_engine(found.bundle)
        found.before = profile(found.baseline, values, options.runs, options.threads, compared)
    engine = found.bundle.manifest.engine or DEFAULT_ENGINE
    for name, graph in found.bundle.manifest.graphs.items():
        seen = QuantizedGraph(name, found.bundle.file(graph.file))
        found.islands += seen.islands()
        found.pairs = tuple(a + b for a, b in zip(found.pairs, seen.pairs(), strict=True))  # type: ignore[assignment]
        found.fallen += fallbacks(seen, found.operators, engine)
    found.islands = timed(found.islands, found.operators)


def _sentences(found: _Found, speed: float = math.nan) -> list[str]:
    """Return the findings, what matters most first."""
    again = command(found.made.stage, found.source) if found.made.stage is not None else "see vlatool quantize --help"
    about_phases = [*(each["message"] for each in found.bundle.manifest.findings), *told(found.phases, again)]
    ruined = len(found.bundle.manifest.findings) + sum(bool(each.nodes) for each in found.phases)
    sentences = about_phases[:ruined]
    if found.layers:
        sentences.append(tables.layers_told(found.layers))
    sentences.append(tables.time_told(found.operators))
    if found.fallen or found.pairs[0]:
        sentences.append(tables.fallbacks_told(found.fallen, found.operators))
    if found.pairs[0]:
        sentences.append(tables.islands_told(found.islands, found.pairs, found.operators))
    sentences += tables.limit_told(found.operators, found.before, _macs(found.bundle), speed)
    return sentences + about_phases[ruined:]


def _macs(bundle: Bundle) -> dict[str, int]:
    """Return precision -> multiply-accumulates of one inference, as the graphs are computed."""
    counted = workload(bundle)
    found: Counter[str] = Counter()
    for name, graph in counted.graphs.items():
        compute = bundle.manifest.graphs[name].compute or "float32"
        for kind, count in graph.macs.items():
            found[compute if kind == "float32" else kind] += count * counted.runs.get(name, 0)
    return dict(found)


def _details(found: _Found) -> Mapping[str, Sequence[Mapping[str, Any]]]:
    """Return the tables that belong to the bundle."""
    action = found.bundle.manifest.spec.action
    units = dict(zip(action.labels, action.units(), strict=False))
    several = len({each.graph for each in found.layers}) > 1
    every = {
        "Layers that cost the accuracy, each alone in int8": tables.layers_table(found.layers, several),
        "What the worst layers do to the action": tables.elements_table(found.layers, units),
        "Time by what it is computed in": tables.precision_table(found.operators),
        "Time by operator": table(found.operators),
        "Layers that fell back": tables.fallbacks_table(found.fallen),
        "Round trips through float": tables.islands_table(found.islands),
    }
    return {title: rows for title, rows in every.items() if rows}
