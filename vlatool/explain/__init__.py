"""Explanation of a bundle's accuracy and speed: layers, operators, the limit, and how to improve it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.module_bundle import no_graph_error
from vlatool.data import named_recording
from vlatool.errors import VlatoolError
from vlatool.explain import _tables as tables
from vlatool.explain._bfloat16 import Phases, measure_phases, phase_sentences
from vlatool.explain._candidates import measure, plan_candidates
from vlatool.explain._float_roundtrips import Fallback, QuantizedGraph, RoundTrip, fallbacks, with_times
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
from vlatool.stage.identity import with_identity

__all__ = ["Options", "explain", "explanation"]


@dataclass(frozen=True)
class Options:
    """Options of an explanation.

    Args:
        baseline: The float32 bundle; searched in the cache when None.
        data: Recorded observations for the errors; the bundle's own when None.
        samples: Largest number of observations.
        suggest: Whether to build and measure candidates.
        seconds: Time limit for measuring the layers, which reduces the number of observations.
        map: Names in the recorded observations, as ``NAME=RECORDED``.
    """

    baseline: Path | None = None
    data: Path | None = None
    samples: int = 16
    runs: int = 20
    threads: int = 1
    suggest: bool = True
    seconds: float = 300.0
    map: tuple[str, ...] = ()


@dataclass
class _Findings:
    """Findings about a bundle."""

    bundle: Bundle
    baseline: Bundle | None
    origin: Origin
    observations: Observations
    layers: list[LayerError] = field(default_factory=list)
    operators: list[Operator] = field(default_factory=list)
    float_operators: list[Operator] = field(default_factory=list)
    round_trips: list[RoundTrip] = field(default_factory=list)
    pairs: tuple[int, int] = (0, 0)
    fallbacks: list[Fallback] = field(default_factory=list)
    reach: dict[str, float] = field(default_factory=dict)
    phases: list[Phases] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def source(self) -> str:
        """The float32 bundle as an argument of a command."""
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
        candidates = []
        if options.suggest and findings.baseline is not None and findings.observations.recorded:
            candidates = plan_candidates(findings.origin.stage, findings.layers, findings.fallbacks, engine)
        values = findings.observations.values
        comparison = measure(bundle, findings.baseline, candidates, values, scratch, options.threads, context)
        sentences = _sentences(findings, comparison.speed)
        sentences[1:1] = tables.suggestion(comparison, findings.source)
        sentences += tables.trial_sentences(comparison, findings.layers)
        findings.warnings += [
            f"the candidate '{candidate.name}' failed: {candidate.failed}"
            for candidate in candidates
            if candidate.failed
        ]
        details = _details(findings)
        rows: list[Row] = []
        for candidate in (comparison.baseline, comparison.current, *comparison.others):
            if candidate is not None:
                own = details if candidate is comparison.current else {}
                row = tables.candidate_row(candidate, comparison, own, findings.source)
                rows.append(row if candidate.bundle is None else with_identity(row, candidate.bundle))
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
    """Return the explanation as a few sentences, for another report, without what cannot be determined.

    Args:
        baseline: The float32 bundle that it was made from.
        samples: Number of observations for measuring the layers.
        seconds: Time limit for measuring the layers, which reduces the number of observations, down to one.
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
    observations = observations_of(bundle, baseline, named_recording(options.data, options.map), options.samples)
    findings = _Findings(bundle, baseline, quantization, observations, warnings=list(quantization.notes))
    if not observations.recorded:
        findings.warnings.append("without recorded observations the layers' errors are not measured (--data FILE)")
    _layers(findings, options.seconds, context)
    _times(findings, options, context)
    findings.phases = measure_phases(bundle, baseline, observations.values, context)
    return findings


def _layers(findings: _Findings, seconds: float, context: Context) -> None:
    """Measure each layer in int8 by itself."""
    stage = sensitivity_stage(findings.origin.stage)
    if stage is None or not findings.observations.recorded:
        return
    if findings.baseline is None:
        findings.warnings.append(
            "the float32 bundle that this one was made from is not in the cache, so no layer could be measured: "
            f"vlatool explain {findings.bundle.path} --baseline FLOAT_BUNDLE"
        )
        return
    try:
        static = isinstance(findings.origin.stage, StaticInt8)
        ranges = ranges_of(findings.baseline, stage, context) if static else {}
        findings.layers = sensitivities(
            findings.baseline, stage, ranges, findings.observations.values, context, seconds=seconds
        )
    except VlatoolError as error:
        findings.warnings.append(f"the layers could not be measured: {error.message} {error.fix}".strip())


def _times(findings: _Findings, options: Options, context: Context) -> None:
    """Profile the bundle and the float32 one, and examine the quantized graphs."""
    values = findings.observations.values
    context.progress("profiling the operators", None)
    findings.operators = profile(findings.bundle, values, options.runs, options.threads)
    engine = findings.bundle.manifest.engine or DEFAULT_ENGINE
    findings.reach = reach_by_dtype(engine, _macs(findings.bundle), options.threads)
    if findings.baseline is not None:
        context.progress("profiling the operators of float32", None)
        compared = reference_engine(findings.bundle)
        findings.float_operators = profile(findings.baseline, values, options.runs, options.threads, compared)
    for name, graph in findings.bundle.manifest.graphs.items():
        seen = QuantizedGraph(name, findings.bundle.file(graph.file))
        findings.round_trips += seen.round_trips()
        findings.pairs = tuple(a + b for a, b in zip(findings.pairs, seen.pairs(), strict=True))  # type: ignore[assignment]
        findings.fallbacks += fallbacks(seen, findings.operators, engine)
    findings.round_trips = with_times(findings.round_trips, findings.operators)


def _sentences(findings: _Findings, speed: float = math.nan) -> list[str]:
    """Return the findings as sentences, the most important first."""
    again = (
        command(findings.origin.stage, findings.source)
        if findings.origin.stage is not None
        else "see vlatool quantize --help"
    )
    about_phases = [
        *(finding["message"] for finding in findings.bundle.manifest.findings),
        *phase_sentences(findings.phases, again),
    ]
    damaged = len(findings.bundle.manifest.findings) + sum(bool(finding.nodes) for finding in findings.phases)
    sentences = about_phases[:damaged]
    if findings.layers:
        sentences.append(tables.layers_sentence(findings.layers))
    sentences.append(tables.time_sentence(findings.operators))
    if findings.fallbacks or findings.pairs[0]:
        sentences.append(tables.fallbacks_sentence(findings.fallbacks, findings.operators))
    if findings.pairs[0]:
        sentences.append(tables.round_trips_sentence(findings.round_trips, findings.pairs, findings.operators))
    macs = _macs(findings.bundle)
    sentences += tables.limit_sentences(findings.operators, findings.float_operators, macs, speed)
    sentences += tables.reach_sentence(findings.operators, macs, findings.reach)
    return sentences + about_phases[damaged:]


def _macs(bundle: Bundle) -> dict[str, int]:
    """Return effective precision -> multiply-accumulates of one inference."""
    counted = workload(bundle)
    macs: Counter[str] = Counter()
    for name, graph in counted.graphs.items():
        compute = bundle.manifest.graphs[name].compute or "float32"
        for kind, count in graph.macs.items():
            macs[compute if kind == "float32" else kind] += count * counted.runs.get(name, 0)
    return dict(macs)


def _details(findings: _Findings) -> Mapping[str, Sequence[Mapping[str, Any]]]:
    """Return the tables of the bundle."""
    action = findings.bundle.manifest.spec.action
    units = dict(zip(action.labels, action.units(), strict=False))
    several = len({layer.graph for layer in findings.layers}) > 1
    tables_by_title = {
        "Layers that cost the accuracy, each alone in int8": tables.layers_table(findings.layers, several),
        "What the worst layers do to the action": tables.elements_table(findings.layers, units),
        "Time by what it is computed in": tables.precision_table(findings.operators),
        "Time by operator": table(findings.operators),
        "Layers that fell back": tables.fallbacks_table(findings.fallbacks),
        "Round trips through float": tables.round_trips_table(findings.round_trips),
    }
    return {title: rows for title, rows in tables_by_title.items() if rows}
