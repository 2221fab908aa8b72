"""Pruned, trained and quantized policies, tried one after the other: the fastest that keep to the budget are judged."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vlatool.accuracy.success_comparison import compare_success
from vlatool.benchmark.latency import Latency
from vlatool.bundle.bundle import Bundle
from vlatool.data import carries_evaluation
from vlatool.episodes.play import EVALUATION_SEEDS
from vlatool.errors import NOT_POSSIBLE
from vlatool.evaluate.recorded import Recorded
from vlatool.files.resumable_work import work_directory
from vlatool.machine.version import VERSION
from vlatool.measures.latency import SPEEDUP
from vlatool.measures.success import SUCCESS_DROP
from vlatool.measures.training import TRAINING_TIME
from vlatool.optimize.budget import budget_of
from vlatool.optimize.build_candidates import candidate, engine_of
from vlatool.optimize.moves import Held, judge_moves
from vlatool.optimize.plan import Plan, transforms
from vlatool.optimize.recipe import StageList
from vlatool.optimize.search import QUICK
from vlatool.optimize.space import Shape, Space, quantizations, space_of
from vlatool.optimize.study import Study, Tried
from vlatool.report import Row
from vlatool.stage.base import Context
from vlatool.stage.cache import STREAMS
from vlatool.stage.controls import training_rows
from vlatool.stage.run import cached_measure

SELECTION_SEEDS = 2 * EVALUATION_SEEDS
"""First seed of the episodes that trials play: no training may reach it, and no evaluation is so long."""
FINALISTS = 3
TIMED_RUNS = 60
STUDY_COLUMN = "the study says"
UNMEASURED_NOTE = "not measured in this run"
CANDIDATE_NOTE = "measured as a candidate"
Table = list[dict[str, Any]]


@dataclass(frozen=True)
class PrunedSearch:
    """Trials of one run, held against the whole policy in float32."""

    plan: Plan
    source: Bundle
    baseline: Bundle
    context: Context

    def run(self, candidates: Mapping[str, StageList]) -> tuple[dict[str, StageList], dict[str, Table]]:
        """Try as many as the recipe says; return the finalists, fastest first, and a table of all.

        Args:
            candidates: name -> stages; how a pruned policy may be quantized.

        Raises:
            RecipeError: when nothing of the policy can be pruned.
            UsageError: when the study cannot be opened.
        """
        if study := self.plan.recipe.pruning.study:
            return self._run(study, candidates)
        directory = self.plan.cache / STREAMS / f"optimize.trials-{self._name().rpartition('-')[2]}"
        with work_directory(directory):  # of this machine, so that an interrupted run goes on
            return self._run(f"sqlite:///{directory.absolute() / 'trials.db'}", candidates)

    def _run(self, url: str, candidates: Mapping[str, StageList]) -> tuple[dict[str, StageList], dict[str, Table]]:
        pruning = self.plan.recipe.pruning
        study = Study(url, self._name(), self._allowed, pruning.seed)
        quantized = study.agree_on(self._quantizations(candidates))
        space = space_of(self.source, pruning, quantized, self.plan.cache, self.context)
        study.begin(space)
        while (asked := study.ask(pruning.trials)) is not None:
            number, shape = asked
            count = len(study.ended_trials()) + 1  # numbers of the study count shapes that were asked for twice, too
            self.context.progress(f"trial {count} of {pruning.trials}: {space.name(shape)}", None)
            study.tell(number, self._try(shape, space))
        tried = study.ended_trials()
        chosen = self._finalists(tried, space)
        more = f"; {elsewhere} under way in other processes" if (elsewhere := study.under_way()) else ""
        plans = {space.name(each.shape): space.stages(each.shape) for each in chosen}
        return plans, {f"Pruned policies, by trials{more}": self._table(tried, space)}

    def _name(self) -> str:
        """Return what trials share that may be compared: the policy, how it is trained and judged, limits and board."""
        recipe = self.plan.recipe
        asked = recipe.pruning.model_dump(mode="json", exclude={"trials", "study", "seed"})
        said = [self.source.hash, asked, recipe.limits.model_dump(mode="json"), recipe.effort.threads,
                self.plan.closed_loop is not None, self.plan.board, VERSION]  # fmt: skip
        digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]
        return f"{self.baseline.manifest.name}-{digest}"

    def _quantizations(self, candidates: Mapping[str, StageList]) -> dict[str, StageList]:
        """Return how the whole policy was quantized: name -> stages, the fastest first."""
        speeds: dict[str, float] = {}
        found = quantizations(candidates)
        for name, stages in found.items():
            with contextlib.suppress(*NOT_POSSIBLE):
                speeds[name] = self._speedup(self._made(stages)[-1])
        return {name: found[name] for name in sorted(speeds, key=lambda name: -speeds[name])}

    def _try(self, shape: Shape, space: Space) -> Tried:
        """Make a policy of a shape, time it and see what it loses; failures say why."""
        try:
            made = self._made(space.stages(shape))
            drop, moves = self._judged(made[-1])
            return Tried(shape, self._speedup(made[-1]), drop, _training_s(made), miss=moves.miss,
                         refused="; ".join(miss.words for miss in moves.missed))  # fmt: skip
        except NOT_POSSIBLE as failure:
            return Tried(shape, note=failure.message)

    def _made(self, stages: StageList) -> tuple[Bundle, ...]:
        return candidate(transforms(stages), self.source, self.baseline, self.plan, self.context)

    def _speedup(self, bundle: Bundle) -> float:
        engine = engine_of(bundle) if self.plan.board_set.is_confined else ""
        threads = self.plan.recipe.effort.threads
        timing = Latency(against=(bundle.path,), iterations=TIMED_RUNS, threads=threads, engine=engine, **QUICK)
        return cached_measure(timing, self.baseline, self.plan.cache, self.context).rows[-1].value(SPEEDUP)

    def _judged(self, bundle: Bundle) -> tuple[float, Held]:
        """Return what a policy loses in paired episodes, and whether it moves worse than allowed.

        Without an environment, it is the error on recorded observations.
        """
        loop = self.plan.closed_loop
        if loop is None or self.plan.recipe.limits.metric:
            return self._error(bundle), Held()
        loop = loop.model_copy(
            update={"episodes": self.plan.recipe.pruning.episodes, "first_seed": SELECTION_SEEDS, "baseline": None}
        )
        rows = [cached_measure(loop, each, self.plan.cache, self.context).rows[-1] for each in (self.baseline, bundle)]
        compared = compare_success(*rows)
        return compared.value(SUCCESS_DROP), judge_moves(compared, self.plan.recipe.limits)

    def _error(self, bundle: Bundle) -> float:
        if not carries_evaluation(self.baseline):
            return math.inf
        recorded = Recorded(baseline=self.baseline.path)
        row = cached_measure(recorded, bundle, self.plan.cache, self.context).rows[-1]
        measured = budget_of(self.plan.recipe.limits, self.baseline.manifest.spec, proxy=False).of(row)
        return math.inf if measured is None or not measured.known else measured.value

    @property
    def _allowed(self) -> float:
        limits = self.plan.recipe.limits
        return limits.max_metric or 0.0 if limits.metric else limits.max_drop

    def _finalists(self, tried: list[Tried], space: Space) -> list[Tried]:
        """Return the fastest pruned ones within the budget, first those that move well; else the most accurate."""
        by_shape = {each.shape: each for each in tried}  # chance may choose one twice
        pruned = [each for each in by_shape.values() if each.speedup > 0 and not space.is_whole(each.shape)]
        inside = [each for each in pruned if each.drop <= self._allowed]
        inside.sort(key=lambda each: (bool(each.refused), -each.speedup))
        return inside[:FINALISTS] or sorted(pruned, key=lambda each: each.drop)[:1]

    def _describe_drop(self, drop: float) -> str:
        if not math.isfinite(drop):
            return ""
        points = self.plan.closed_loop is not None and not self.plan.recipe.limits.metric
        return f"{100 * drop:.1f} points" if points else f"{drop:.4g}"

    def _table(self, tried: list[Tried], space: Space) -> Table:
        """Return all trials; what the study says of those that were not made in this run stands in a column of its own.

        A study may be written by anybody who reaches it, so that nothing of it is shown as measured.
        """
        front = front_of([each for each in tried if not each.elsewhere])
        return [
            {"policy": space.name(each.shape), **self._cells(each, each in front)}
            for each in sorted(tried, key=lambda each: (each.elsewhere, -each.speedup))
        ]

    def _cells(self, each: Tried, on_the_front: bool) -> dict[str, Any]:
        speed = f"{each.speedup:.2f}x" if each.speedup else ""
        note = each.note or each.refused
        if each.elsewhere:
            said = ", ".join(
                filter(None, (speed, self._describe_drop(each.drop) and f"drop {self._describe_drop(each.drop)}", note))
            )
            words = {"note": UNMEASURED_NOTE, STUDY_COLUMN: said or "nothing"}
            return dict.fromkeys(("speed-up", "drop", "within", "on the front", "training"), "") | words
        return {
            "speed-up": speed,
            "drop": self._describe_drop(each.drop),
            "within": "yes" if each.drop <= self._allowed and not each.refused else "no",
            "on the front": "yes" if on_the_front else "",
            "training": f"{each.training_s / 60:.1f} min" if each.training_s else "",
            "note": note,
            STUDY_COLUMN: "",
        }


def with_measured(table: Table, rows: Mapping[str, Row]) -> Table:
    """Return the trials with the speed-up and the drop of those that were measured in this run after all.

    Args:
        rows: Name -> row of each candidate, as it was measured.
    """
    lines = []
    for line in table:
        speed = rows[line["policy"]].get(SPEEDUP) if line["policy"] in rows else None
        if not line["within"] and speed is not None and speed.known:
            line = {**line, "speed-up": f"{speed.value:.2f}x", "note": CANDIDATE_NOTE}
        lines.append(line)
    return lines


def front_of(tried: list[Tried]) -> list[Tried]:
    """Return the trials that no other one beats in both respects."""
    made = [each for each in tried if each.speedup > 0]
    return [
        each
        for each in made
        if not any(
            other.speedup >= each.speedup and other.drop <= each.drop and
            (other.speedup, other.drop) != (each.speedup, each.drop)
            for other in made
        )
    ]  # fmt: skip


def _training_s(made: tuple[Bundle, ...]) -> float:
    """Return the seconds that the trainings of a policy took when it was trained."""
    return sum(item.value for row in training_rows(made) for item in TRAINING_TIME.members(row).values())
