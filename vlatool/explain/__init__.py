"""Why a bundle is as accurate and as fast as it is: the layers, the operators, the limit, and what to do about it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.module_bundle import no_graph_error
from vlatool.errors import VlatoolError
from vlatool.explain import _tables as tables
from vlatool.explain._bfloat16 import Phases, phase_sentences, phases
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
from vlatool.files.scratch import scratch_directory
from vlatool.graph.workload import workload
from vlatool.machine.host import before_run
from vlatool.measurement.reach import reach_by_dtype
from vlatool.measurement.validity import busy, validity
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
class _Findings:
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
    reach: dict[str, float] = field(default_factory=dict)
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
    host = before_run()
    contended = tuple(busy(host))
    findings = _find(bundle, options, context)
    with scratch_directory() as scratch:
        engine = bundle.manifest.engine or DEFAULT_ENGINE
        suggests = options.suggest and findings.baseline is not None and findings.seen.recorded
        tried = plans(findings.made.stage, findings.layers, findings.fallen, engine) if suggests else []
        values = findings.seen.values
        contest = measure(bundle, findings.baseline, tried, values, scratch, options.threads, context)
        sentences = _sentences(findings, contest.speed)
        sentences[1:1] = tables.suggestion(contest, findings.source)
        sentences += tables.trial_sentences(contest, findings.layers)
        findings.warnings += [
            f"the candidate '{candidate.name}' failed: {candidate.failed}" for candidate in tried if candidate.failed
        ]
        details = _details(findings)
        rows: list[Row] = []
        for candidate in (contest.baseline, contest.now, *contest.others):
            if candidate is not None:
                own = details if candidate is contest.now else {}
                rows.append(tables.candidate_row(candidate, contest, own, findings.source))
    name = str(bundle.manifest.made_by.get("stage", "")).rpartition(".")[2]
    rows = [replace(row, name=name or row.name) if row.name == "as it is" else row for row in rows]
    title = f"Why {bundle.manifest.name} ({name or 'as it is'}) is as accurate and as fast as it is"
    return Report(
        "explain",
        title,
        summary=tuple(sentences),
        rows=tuple(rows),
        environment=host,
        warnings=tuple(findings.warnings),
        validity=validity(contended),
        findings=contended,
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


def _find(bundle: Bundle, options: Options, context: Context) -> _Findings:
    if not bundle.manifest.graphs:
        raise no_graph_error(bundle, "explain")
    quantization = origin(bundle)
    baseline = find_baseline(bundle, quantization, options.baseline)
    seen = observations_of(bundle, baseline, options.data, options.samples)
    findings = _Findings(bundle, baseline, quantization, seen, warnings=list(quantization.notes))
    if not seen.recorded:
        findings.warnings.append(
            "there are no recorded observations: the layers' errors are not measured (--data FILE)"
        )
    _layers(findings, options.seconds, context)
    _times(findings, options, context)
    findings.phases = phases(bundle, baseline, seen.values, context)
    return findings


def _layers(findings: _Findings, seconds: float, context: Context) -> None:
    """Measure each layer alone in int8."""
    stage = sensitivity_stage(findings.made.stage)
    if stage is None or not findings.seen.recorded:
        return
    if findings.baseline is None:
        findings.warnings.append(
            "the float32 bundle that this one was made from is not in the cache, so no layer could be measured: "
            f"vlatool explain {findings.bundle.path} --baseline FLOAT_BUNDLE"
        )
        return
    try:
        static = isinstance(findings.made.stage, StaticInt8)
        ranges = ranges_of(findings.baseline, stage, context) if static else {}
        findings.layers = sensitivities(
            findings.baseline, stage, ranges, findings.seen.values, context, seconds=seconds
        )
    except VlatoolError as error:
        findings.warnings.append(f"the layers could not be measured: {error.message} {error.fix}".strip())


def _times(findings: _Findings, options: Options, context: Context) -> None:
    """Profile the bundle and the float32 one, and look at the quantized graphs."""
    values = findings.seen.values
    context.progress("profiling the operators", None)
    findings.operators = profile(findings.bundle, values, options.runs, options.threads)
    engine = findings.bundle.manifest.engine or DEFAULT_ENGINE
    findings.reach = reach_by_dtype(engine, _macs(findings.bundle), options.threads)
    if findings.baseline is not None:
        context.progress("profiling the operators of float32", None)
        compared = reference_engine(findings.bundle)
        findings.before = profile(findings.baseline, values, options.runs, options.threads, compared)
    engine = findings.bundle.manifest.engine or DEFAULT_ENGINE
    for name, graph in findings.bundle.manifest.graphs.items():
        seen = QuantizedGraph(name, findings.bundle.file(graph.file))
        findings.islands += seen.islands()
        findings.pairs = tuple(a + b for a, b in zip(findings.pairs, seen.pairs(), strict=True))  # type: ignore[assignment]
        findings.fallen += fallbacks(seen, findings.operators, engine)
    findings.islands = timed(findings.islands, findings.operators)


def _sentences(findings: _Findings, speed: float = math.nan) -> list[str]:
    """Return the findings, what matters most first."""
    again = (
        command(findings.made.stage, findings.source)
        if findings.made.stage is not None
        else "see vlatool quantize --help"
    )
    about_phases = [
        *(finding["message"] for finding in findings.bundle.manifest.findings),
        *phase_sentences(findings.phases, again),
    ]
    ruined = len(findings.bundle.manifest.findings) + sum(bool(finding.nodes) for finding in findings.phases)
    sentences = about_phases[:ruined]
    if findings.layers:
        sentences.append(tables.layers_sentence(findings.layers))
    sentences.append(tables.time_sentence(findings.operators))
    if findings.fallen or findings.pairs[0]:
        sentences.append(tables.fallbacks_sentence(findings.fallen, findings.operators))
    if findings.pairs[0]:
        sentences.append(tables.islands_sentence(findings.islands, findings.pairs, findings.operators))
    macs = _macs(findings.bundle)
    sentences += tables.limit_sentences(findings.operators, findings.before, macs, speed)
    sentences += tables.reach_sentence(findings.operators, macs, findings.reach)
    return sentences + about_phases[ruined:]


def _macs(bundle: Bundle) -> dict[str, int]:
    """Return precision -> multiply-accumulates of one inference, as the graphs are computed."""
    counted = workload(bundle)
    macs: Counter[str] = Counter()
    for name, graph in counted.graphs.items():
        compute = bundle.manifest.graphs[name].compute or "float32"
        for kind, count in graph.macs.items():
            macs[compute if kind == "float32" else kind] += count * counted.runs.get(name, 0)
    return dict(macs)


def _details(findings: _Findings) -> Mapping[str, Sequence[Mapping[str, Any]]]:
    """Return the tables that belong to the bundle."""
    action = findings.bundle.manifest.spec.action
    units = dict(zip(action.labels, action.units(), strict=False))
    several = len({layer.graph for layer in findings.layers}) > 1
    every = {
        "Layers that cost the accuracy, each alone in int8": tables.layers_table(findings.layers, several),
        "What the worst layers do to the action": tables.elements_table(findings.layers, units),
        "Time by what it is computed in": tables.precision_table(findings.operators),
        "Time by operator": table(findings.operators),
        "Layers that fell back": tables.fallbacks_table(findings.fallen),
        "Round trips through float": tables.islands_table(findings.islands),
    }
    return {title: rows for title, rows in every.items() if rows}
