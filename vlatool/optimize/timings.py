"""The latency of float32 and every candidate: in one run, or, where the engines cannot be compared, in one for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

from vlatool.benchmark.latency import Latency
from vlatool.boards.predict import predictions
from vlatool.bundle.bundle import Bundle
from vlatool.hardware.profile import Profile
from vlatool.machine.instruction_sets import ENGINE, BoardSet
from vlatool.optimize.engines_apart import REFERENCE, joined
from vlatool.optimize.recipe import Effort
from vlatool.report import Measurement, Row
from vlatool.runtime.engine import DEFAULT_ENGINE
from vlatool.stage.base import Context
from vlatool.stage.run import cached_measure

Timed = tuple[dict[str, Row], tuple[str, ...]]
"""Name -> row, float32 first, and what a reader should know."""


@dataclass(frozen=True)
class Timing:
    """How bundles are timed.

    Args:
        effort: Inferences and threads.
        where: The set that OpenVINO is confined to, if it is.
        cache: Where measurements are kept.
        context: For progress.
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
        if not self.where.confined:
            torch = [source] if source.manifest.source and source.path != baseline.path else []
            return self._timed(bundles, torch)
        own = {name: bundle for name, bundle in bundles.items() if name != base and engine_of(bundle) == ENGINE}
        rows, told = self._timed({name: bundle for name, bundle in bundles.items() if name not in own})
        theirs, more = self._timed({base: baseline, **own}, engine=ENGINE) if own else ({}, ())
        return joined(rows, theirs, list(bundles), self.where), tuple(dict.fromkeys((*told, *more)))

    def _timed(self, bundles: Mapping[str, Bundle], torch: Sequence[Bundle] = (), engine: str = "") -> Timed:
        """Time bundles in one run, eager torch last; all in one engine where it is named."""
        base, *others = bundles
        against = tuple(bundle.path for bundle in [*(bundles[name] for name in others), *torch])
        effort = {"iterations": self.effort.iterations, "threads": self.effort.threads, "engine": engine}
        stage = Latency(against=against, duration=0, phase=False, **effort)
        begun = now()
        report = cached_measure(stage, bundles[base], self.cache, self.context, fresh=self.fresh)
        kept = (f"the latencies were measured before, at {report.created}; --fresh measures again",)
        rows = dict(zip(bundles, report.rows, strict=False))
        named = {name: replace(row, name=name) for name, row in rows.items()}
        eager = report.rows[-1].get("latency_p50") if torch else None
        if eager is not None:
            own = replace(eager, name="torch_eager_latency_p50", note="eager torch, same run")
            named[base] = replace(named[base], measurements=(*named[base].measurements, own))
        seen = [
            "; ".join(filter(None, (each.reason, each.remedy))) for each in report.findings if each.effect != "note"
        ]
        return named, (*report.warnings, *seen, *(kept if report.created < begun else ()))


def foretold_by_engine(
    profile: Profile, bundles: Mapping[str, Bundle], where: BoardSet
) -> dict[str, list[Measurement]]:
    """Return what is predicted for each bundle on a board; where OpenVINO is confined, float32 in it as well.

    Args:
        profile: The board.
        bundles: Name -> bundle, float32 first.
        where: The set that OpenVINO is confined to, if it is.
    """
    found = {name: predictions(profile, bundle) for name, bundle in bundles.items()}
    (base, baseline), *_ = bundles.items()
    own = predictions(profile, baseline, ENGINE) if where.confined else []
    found[base] += [replace(each, name=REFERENCE) for each in own if each.name == "latency_p50"]
    return found


def engine_of(bundle: Bundle) -> str:
    """Return the engine that a bundle was made for."""
    return bundle.manifest.engine or DEFAULT_ENGINE


def now() -> str:
    """Return the time in UTC, ISO 8601, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
