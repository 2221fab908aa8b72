"""The search of ``optimize``: engines, methods and mixed-precision plans; slow candidates are dropped early.

1. Every **variant** (an engine, a method, a compute dtype) is built and tried: a few timed inferences in turns with
   float32, and its error on calibration observations.
2. Options that gain something alone are **combined**; what was measured of each alone decides which.
3. Where variants faster than the best one inside the budget miss the budget, the layers that cost the accuracy are
   found by running each alone in int8, and left in float in growing numbers until the budget is kept (a mixed-precision
   plan).
4. The fastest few inside the budget, and those that miss it by a hair on calibration observations, become candidates,
   which ``optimize`` measures in full.

Each trial is a cached stage: an interrupted search goes on where it was.
"""

from __future__ import annotations

import glob
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool import registry
from vlatool.benchmark.latency import Latency
from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations, recordings_of
from vlatool.errors import NOT_POSSIBLE, GraphError, PluginError
from vlatool.evaluate.recorded import Recorded
from vlatool.hardware.profile import Profile
from vlatool.machine.instruction_sets import board_set
from vlatool.machine.target import target_of
from vlatool.measures.latency import SPEEDUP
from vlatool.optimize.budget import budget_of
from vlatool.optimize.build_candidates import chain, engine_of
from vlatool.optimize.plan import transforms
from vlatool.optimize.recipe import Limits, StageList
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.engine import engine_class, engine_names, is_installed
from vlatool.stage.base import Context
from vlatool.stage.build import stage_class
from vlatool.stage.run import cached_measure

if TYPE_CHECKING:
    from vlatool.sensitivity.layers import LayerError

FINALISTS = 3
SELECTION_SHARE = 0.9
"""Share of the budget that a plan may use on calibration observations: those that it is judged on are others."""
NEAR_BUDGET = 1.05
"""Share of the budget up to which a fast plan is evaluated in full, though it misses the budget on calibration
observations."""
SLOWER = 0.97
"""Share of a plan's speed that an option must keep, as far as a few inferences can say, to be combined with others."""
MAX_COMBINATIONS = 3
"""Combinations of options that are tried for one plan, at most."""
ROUNDS = 5
"""Plans that are tried for one variant, at most."""
SECONDS = 120.0
"""What the sensitivity of all layers may take; fewer samples are used for slow policies."""
MAX_OBSERVATIONS = 256
"""Observations that errors of plans are taken on, at most."""
SAMPLES = 8
"""Observations on which it is measured, at most."""
TIMED_RUNS = 20
QUICK: dict[str, Any] = {"duration": 0, "cold": False, "phase": False, "answers": False, "reach": False}


@dataclass(frozen=True)
class Trial:
    """What a variant did when it was tried.

    Args:
        speedup: Against float32 in ONNX Runtime, or in ``engine`` where that is named, from a few inferences; 0 when it
            could not be made.
        error: Error on calibration observations, in the measure of the budget (or the nearest that needs no episodes).
        within: Whether ``error`` keeps to the budget.
        engine: What its speed is compared within; empty where all plans are compared with each other.
        fastest: What its speed may be, as far as those few inferences say: the upper end of the interval.
    """

    name: str
    stages: StageList
    speedup: float = 0.0
    error: float = math.inf
    within: bool = False
    note: str = ""
    engine: str = ""
    fastest: float = 0.0


@dataclass
class Search:
    """One run of the search, for a board or, without a profile, for this host."""

    baseline: Bundle
    limits: Limits
    profile: Profile | None
    cache: Path
    context: Context
    threads: int = 1

    def __post_init__(self) -> None:
        self.trials: list[Trial] = []
        self._seen: dict[str, str] = {}
        self._begun = time.monotonic()
        self._apart = board_set(self.profile).is_confined
        self._planned = 1
        self._layers: list[LayerError] | None = None
        self._observations = recorded_observations(self.baseline, MAX_OBSERVATIONS)
        self.budget = budget_of(self.limits, self.baseline.manifest.spec)

    def run(self, candidates: Mapping[str, StageList]) -> dict[str, StageList]:
        """Try everything; return the finalists that are not among the given candidates, fastest first."""
        variants = {**candidates, **variants_for(self.profile, calibrated=bool(self._observations))}
        self._planned = len(variants) + 2 * ROUNDS
        for name, stages in variants.items():
            self._try(name, stages)
        for base in list(self.trials):
            self._combine(base)
        self._try_methods()
        self._repair()
        chosen = self._finalists()
        return {trial.name: trial.stages for trial in chosen if trial.name not in candidates}

    def tables(self) -> dict[str, list[dict[str, Any]]]:
        """Return what was tried, and which layers cost the accuracy, as tables of the report."""
        tables: dict[str, list[dict[str, Any]]] = {
            "Plans tried by the search": [
                {
                    "plan": trial.name,
                    "speed-up": f"{trial.speedup:.2f}x" if trial.speedup else "",
                    **({"against float32 in": trial.engine} if self._apart else {}),
                    self.budget.name: f"{trial.error:.4g}" if math.isfinite(trial.error) else "",
                    "within": "yes" if trial.within else "no",
                    "note": trial.note,
                }
                for trial in sorted(self.trials, key=lambda trial: (trial.engine, -trial.speedup))
            ]
        }
        if self._layers:
            tables["Layers by what they cost when they alone are int8"] = [
                {"layer": layer.name, "error": f"{layer.error:.4g}", "share of MACs": f"{layer.macs_share:.1%}"}
                for layer in self._layers[:15]
            ]
        return tables

    def _try(self, name: str, stages: StageList) -> Trial:
        """Build a plan, time it against float32 and measure its error; failures are trials that say why."""
        done = len(self.trials)
        self._planned = max(self._planned, done + 1)
        left = (time.monotonic() - self._begun) / done * (self._planned - done) if done else math.nan
        rest = f", about {left:.0f} s left" if done else ""
        self.context.progress(f"search: plan {done + 1} of at most {self._planned}{rest}: {name}", done / self._planned)
        quiet = replace(self.context, progress=lambda _what, _share: None)
        try:
            made = chain(transforms(stages), self.baseline, self.profile, self.limits.accept, self.cache, quiet)
            bundle = made[-1]
            twin = self._seen.setdefault(graphs_of(bundle), name)
            if twin != name:  # no product has enough rows to become a convolution, say
                raise GraphError(f"It has the graphs of {twin}.", f"look at {twin} in its place")
            engine = engine_of(bundle) if self._apart else ""
            timing = Latency(
                against=(bundle.path,), iterations=TIMED_RUNS, threads=self.threads, engine=engine, **QUICK
            )
            timed = cached_measure(timing, self.baseline, self.cache, quiet).rows[-1].get(SPEEDUP)
            speedup, fastest = (timed.value, timed.high or timed.value) if timed else (math.nan, math.nan)
            error = self._error(bundle, quiet)
            trial = Trial(
                name, stages, speedup, error, error <= SELECTION_SHARE * self.budget.value, "", engine, fastest
            )
        except NOT_POSSIBLE as failure:
            trial = Trial(name, stages, note=failure.message)
        self.trials.append(trial)
        return trial

    def _error(self, bundle: Bundle, context: Context) -> float:
        count = max(8, min(len(self._observations), 64))
        whole = recordings_of(self.baseline).calibration
        recorded = Recorded(data=whole, baseline=self.baseline.path, samples=count)
        row = cached_measure(recorded, bundle, self.cache, context).rows[-1]
        error = self.budget.of(row)
        return math.inf if error is None or not error.known else error.value

    def _combine(self, base: Trial) -> None:
        """Try the options that gain something over a plan together, then without those that cost most accuracy."""
        useful = {trial.name: (trial, extra) for trial, extra in self._extended(base) if _useful(base, trial, extra)}
        chosen = sorted(useful.values(), key=lambda one: one[0].error)
        for _ in range(MAX_COMBINATIONS):
            if len(chosen) < 2:
                return
            ((name, options),) = base.stages[-1].items()
            together = {**options, **{key: value for _, extra in chosen for key, value in extra.items()}}
            endings = sorted(trial.name.removeprefix(base.name) for trial, _ in chosen)
            made = self._try(f"{base.name}{''.join(endings)}", (*base.stages[:-1], {name: together}))
            if made.error <= NEAR_BUDGET * self.budget.value:
                return
            costly = [one for one in chosen if one[0].error > base.error]
            if not costly:
                return
            chosen.remove(costly[-1])

    def _extended(self, base: Trial) -> list[tuple[Trial, dict[str, Any]]]:
        """Return the trials that are a plan with one option more, each with that option."""
        ((name, options),) = base.stages[-1].items()
        found = []
        for trial in self.trials:
            if trial.stages[:-1] != base.stages[:-1] or name not in trial.stages[-1] or not base.speedup:
                continue
            extra = {key: value for key, value in trial.stages[-1][name].items() if options.get(key) != value}
            if len(extra) == 1 and options.items() <= trial.stages[-1][name].items():
                found.append((trial, extra))
        return found

    def _try_methods(self) -> None:
        """Choose the ranges of fast plans outside the budget in the other ways that were tried of slower ones.

        Which way is the most accurate depends on what is int8: one that loses on products of weights may win once the
        products of attention are int8, too.
        """
        left = MAX_COMBINATIONS
        for base in sorted(self.trials, key=lambda trial: -trial.speedup):
            ((name, given),) = base.stages[-1].items()
            tried = [trial.stages[-1][name] for trial in self.trials if name in trial.stages[-1]]
            for method in dict.fromkeys(options["method"] for options in tried if "method" in options):
                options = {**given, "method": method}
                if left and options not in tried and self._is_worth_mending(base):
                    self._try(f"{base.name}_{method}", (*base.stages[:-1], {name: options}))
                    left -= 1

    def _is_worth_mending(self, trial: Trial) -> bool:
        """Return whether a plan is outside the budget, and faster than what is inside."""
        rivals = [other for other in self.trials if other.within and other.engine == trial.engine]
        best = max((other.speedup for other in rivals), default=0.0)
        return not trial.within and trial.speedup > 1.05 * best and math.isfinite(trial.error)

    def _repair(self) -> None:
        """Leave sensitive layers in float where a plan is fast enough to be worth it, but outside the budget."""
        for trial in sorted(self.trials, key=lambda trial: -trial.speedup):
            stage = transforms(trial.stages)[-1]
            if self._is_worth_mending(trial) and isinstance(stage, StaticInt8):
                self._mix(trial, stage)

    def _mix(self, trial: Trial, stage: StaticInt8) -> None:
        """Grow the set of layers that stay in float until the budget is kept, then try to shrink it."""
        layers = self._sensitivities(stage)
        if not layers:
            return
        ranked = sorted(layers, key=lambda layer: -(layer.error**2) / max(layer.macs_share, 1e-4))
        count = self._estimate(ranked, trial.error)
        too_few, enough = 0, len(ranked)
        for _ in range(ROUNDS):
            if count <= too_few or count >= enough:
                break
            names = [glob.escape(layer.name) for layer in ranked[:count]]
            options = {**stage.options(), "exclude": [*stage.exclude, *names]}
            stages = (*trial.stages[:-1], {stage.name(): options})
            mixed = self._try(f"{trial.name}_mixed{count}", stages)
            if mixed.within:
                enough = count
                count = (too_few + count) // 2
            else:
                too_few = count
                count = min(2 * count, (count + enough) // 2) if enough < len(ranked) else 2 * count

    def _estimate(self, ranked: list[LayerError], error: float) -> int:
        """Return how many layers must go, were errors independent: their squares add up."""
        total = sum(layer.error**2 for layer in ranked) or 1.0
        allowed = (SELECTION_SHARE * self.budget.value / error) ** 2 if error else 1.0
        kept = 1.0
        for count, layer in enumerate(ranked, 1):
            kept -= layer.error**2 / total
            if kept <= allowed:
                return count
        return len(ranked)

    def _sensitivities(self, stage: StaticInt8) -> list[LayerError]:
        from vlatool.sensitivity.child_process import sensitivities_in_child

        if self._layers is None:
            stage = stage.model_copy(update={"attention": False, "elementwise": False})
            try:
                self._layers = sensitivities_in_child(
                    self.baseline, stage, MAX_OBSERVATIONS, SAMPLES, self.context, SECONDS
                )
            except GraphError as error:  # the plans that were tried stand
                self.context.progress(f"search: the layers could not be measured: {error.message}", None)
                self._layers = []
        return self._layers

    def _finalists(self) -> list[Trial]:
        """Return the finalists of all plans that are compared with each other."""
        timed = [trial for trial in self.trials if trial.speedup > 0]
        engines = dict.fromkeys(trial.engine for trial in timed)
        return [best for engine in engines for best in self._finalists_of([t for t in timed if t.engine == engine])]

    def _finalists_of(self, timed: list[Trial]) -> list[Trial]:
        """Return the fastest plans inside the budget, or the nearest to it when none is inside."""
        fastest = sorted(timed, key=lambda trial: -trial.speedup)
        near = [trial for trial in fastest if trial.error <= NEAR_BUDGET * self.budget.value]
        if not near:
            return sorted(timed, key=lambda trial: trial.error)[:1]
        fast = [trial for trial in near if trial.speedup >= 0.8 * near[0].speedup][:FINALISTS]
        inside = [trial for trial in near if trial.within]
        safe = inside[:1] if not any(trial.within for trial in fast) else []
        accurate = min(near, key=lambda trial: trial.error)
        slow = accurate in fast or accurate in safe or accurate.speedup < 1.0
        return [*fast, *safe, *([] if slow else [accurate])]


def _useful(base: Trial, trial: Trial, extra: Mapping[str, Any]) -> bool:
    """Return whether an option gains something: a way to choose ranges is more accurate, another one not slower.

    On a busy machine a few inferences cannot tell which plan is faster: what may be as fast is tried.
    """
    if max(trial.speedup, trial.fastest) < SLOWER * base.speedup:
        return False
    return trial.error < base.error if "method" in extra else trial.speedup > 0


def variants_for(profile: Profile | None, calibrated: bool) -> dict[str, StageList]:
    """Return the plans that every search for a board (None: this host) begins with: name -> stages."""
    known = engine_names()
    board = known if profile is None else [name for name in known if name in profile.engines]
    variants: dict[str, StageList] = {}
    target = target_of(profile)
    for name in board:
        if is_installed(name):
            variants |= engine_class(name).variants(target, calibrated)
    for name in registry.names("quantize"):
        try:
            method = stage_class(f"quantize.{name}")
        except PluginError:  # doctor says so; nobody asked for it here
            continue
        variants |= {f"{name}{ending}": ({method.name(): dict(how)},) for ending, how in method.tried.items()}
    return variants


def graphs_of(bundle: Bundle) -> str:
    """Return what two bundles share that compute the same on the same engine."""
    manifest = bundle.manifest
    files = sorted(f"{path} {record.sha256}" for path, record in manifest.files.items() if path.startswith("graphs/"))
    computes = sorted(f"{name} {graph.compute}" for name, graph in manifest.graphs.items())
    return "\n".join([manifest.engine, *computes, *files])
