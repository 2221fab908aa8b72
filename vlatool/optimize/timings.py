"""The latency of float32 and every candidate: in one run, or, where the engines cannot be compared, in one for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

from vlatool.benchmark.latency import Latency
from vlatool.bundle.bundle import Bundle
from vlatool.machine.instruction_sets import ENGINE, BoardSet
from vlatool.measures.latency import LATENCY_P50, OPENVINO_FLOAT32_P50, SPEEDUP, TORCH_EAGER_P50
from vlatool.optimize.build_candidates import engine_of
from vlatool.optimize.recipe import Effort
from vlatool.report import Measurement, Row
from vlatool.stage.base import Context
from vlatool.stage.run import cached_measure

IN_OPENVINO = "float32 in OpenVINO"
OWN_SET = "this host's own instruction set"
Timed = tuple[dict[str, Row], tuple[str, ...]]
"""Name -> row, float32 first, and what a reader should know."""


@dataclass(frozen=True)
class Timing:
    """How bundles are timed.

    Args:
        where: The set that OpenVINO is confined to, if it is.
        fresh: Measure again, even what was measured before.
    """

    effort: Effort
    where: BoardSet
    cache: Path
    context: Context
    fresh: bool = False

    def rows(self, source: Bundle, bundles: Mapping[str, Bundle]) -> Timed:
        """Time bundles.

        Args:
            source: Of eager torch, which is timed too, but for where OpenVINO is confined: torch would be, in part.
            bundles: Name -> bundle, float32 first.
        """
        (base, baseline), *_ = bundles.items()
        if not self.where.is_confined:
            torch = [source] if source.manifest.source and source.path != baseline.path else []
            return self._timed(bundles, torch)
        own = {name: bundle for name, bundle in bundles.items() if name != base and engine_of(bundle) == ENGINE}
        rows, warnings = self._timed({name: bundle for name, bundle in bundles.items() if name not in own})
        theirs, more = self._timed({base: baseline, **own}, engine=ENGINE) if own else ({}, ())
        return join_rows(rows, theirs, list(bundles), self.where), tuple(dict.fromkeys((*warnings, *more)))

    def _timed(self, bundles: Mapping[str, Bundle], torch: Sequence[Bundle] = (), engine: str = "") -> Timed:
        """Time bundles in one run, eager torch last; all in one engine where it is named."""
        base, *others = bundles
        against = tuple(bundle.path for bundle in [*(bundles[name] for name in others), *torch])
        effort = {"iterations": self.effort.iterations, "threads": self.effort.threads, "engine": engine}
        stage = Latency(against=against, duration=0, phase=False, **effort)
        begun = utc_now()
        report = cached_measure(stage, bundles[base], self.cache, self.context, fresh=self.fresh)
        kept = (f"the latencies were measured before, at {report.created}; --fresh measures again",)
        rows = dict(zip(bundles, report.rows, strict=False))
        named = {name: replace(row, name=name) for name, row in rows.items()}
        eager = report.rows[-1].get(LATENCY_P50) if torch else None
        if eager is not None:
            own = TORCH_EAGER_P50.relabel(eager, "eager torch, same run")
            named[base] = replace(named[base], measurements=(*named[base].measurements, own))
        seen = [
            "; ".join(filter(None, (finding.reason, finding.remedy)))
            for finding in report.findings
            if finding.effect != "note"
        ]
        return named, (*report.warnings, *seen, *(kept if report.created < begun else ()))


def join_rows(
    ours: Mapping[str, Row], theirs: Mapping[str, Row], order: Sequence[str], where: BoardSet
) -> dict[str, Row]:
    """Return the rows of two runs, one for each engine, in an order.

    Args:
        ours: ONNX Runtime's plans by name, the baseline first.
        theirs: OpenVINO's plans by name, after the baseline as OpenVINO runs it.
        where: The set that OpenVINO is confined to.
    """
    base = order[0]
    rows = {name: replace(row, measurements=_noted(row, OWN_SET)) for name, row in ours.items()}
    reference = theirs[base].get(LATENCY_P50) if theirs else None
    if reference is not None:
        note = f"{IN_OPENVINO}, in the run of its plans"
        own = replace(OPENVINO_FLOAT32_P50.relabel(reference, note), where=where.where)
        rows[base] = replace(rows[base], measurements=(*rows[base].measurements, own))
    rows[base] = replace(rows[base], role="baseline")  # of a run alone it is none
    rows |= {name: replace(row, measurements=_noted(row, where.ratio)) for name, row in theirs.items() if name != base}
    return {name: rows[name] for name in order}


def _noted(row: Row, what: str) -> tuple[Measurement, ...]:
    """Say of a row's speed-up what it is a ratio of."""
    of = IN_OPENVINO if what != OWN_SET else "float32 in ONNX Runtime"
    note = f"ratio of medians to {of}, interleaved: {what}"
    return tuple(replace(number, note=note) if number.name == SPEEDUP.name else number for number in row.measurements)


def relabel_where(rows: Mapping[str, Row], engines: Mapping[str, str], where: BoardSet) -> dict[str, Row]:
    """Return the rows with OpenVINO's measurements placed where they were taken, if that is a host that is confined."""
    if not where.is_confined:
        return dict(rows)

    def relabel(number: Measurement) -> Measurement:
        return replace(number, where=where.where) if number.origin == "measured" else number

    return {
        name: replace(row, measurements=tuple(map(relabel, row.measurements))) if engines.get(name) == ENGINE else row
        for name, row in rows.items()
    }  # fmt: skip


def with_predictions(rows: Mapping[str, Row], predicted: Mapping[str, Sequence[Measurement]]) -> dict[str, Row]:
    """Return the rows, float32 first, with what is predicted for each; float32 also has its latency in OpenVINO."""
    base = next(iter(rows))
    apart = [number for number in predicted.get(IN_OPENVINO, ()) if number.name == LATENCY_P50.name]
    added = {**predicted, base: (*predicted.get(base, ()), *map(OPENVINO_FLOAT32_P50.relabel, apart))}
    return {name: replace(row, measurements=(*row.measurements, *added.get(name, ()))) for name, row in rows.items()}


def utc_now() -> str:
    """Return the time in UTC, ISO 8601, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
