"""Success rate in the closed loop of a gymnasium environment, on paired seeds."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from vlatool.accuracy.credibility import Credibility, credibility
from vlatool.accuracy.disturbance_drops import with_disturbed, without_effect
from vlatool.accuracy.episode_choice import with_episode
from vlatool.accuracy.success_comparison import Outcome, compare_success, repeated_starts, success_row, with_chance
from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.program import slow_part
from vlatool.episodes.controls import CONTROLS
from vlatool.episodes.environment import timeout_of
from vlatool.episodes.jobs import check_opens, disturbances_of, run_jobs
from vlatool.episodes.play import EVALUATION_SEEDS, EpisodesJob, jobs_for
from vlatool.errors import DataError, SourceError, UsageError
from vlatool.evaluate._loop_latency import loop_latency, with_latency
from vlatool.evaluate._names import BASELINE, names_of
from vlatool.evaluate._player import Player
from vlatool.evaluate._replay import check_video_of, played_again
from vlatool.evaluate._sentences import found_wrong, sentences
from vlatool.evaluate._sequential import played_until, sentence, with_decision
from vlatool.evaluate._training_overlap import FIX, seen_in_training
from vlatool.files.resumable_work import Store
from vlatool.hardware.profile import Profile
from vlatool.machine.host import fingerprint
from vlatool.measures import series, with_derived
from vlatool.measures.success import SUCCESS
from vlatool.module.factory import factory_file, split_factory
from vlatool.module.source import describe
from vlatool.report import Report, Row
from vlatool.runtime.control import build_controller, layers, options_of
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.interface import Action
from vlatool.stage.base import Context, Measure
from vlatool.stage.identity import with_identity
from vlatool.stats.starts import distinct_starts
from vlatool.user_code import trust

if TYPE_CHECKING:
    from typing_extensions import Self

ALL = "all"
"""Every disturbance that there is."""
STRONGEST = 10
"""The largest strength of a disturbance."""
CONTROL_EPISODES = 20
"""Episodes of each control, or a tenth of the policy's where that is more."""

Run = Callable[[Bundle, list[EpisodesJob], str], list[Outcome]]
"""Bundle, jobs and whose they are -> outcomes."""


class ClosedLoop(Measure):
    """Run episodes in a gymnasium environment: success rate with Wilson interval, and McNemar's exact test when paired.

    With a baseline, actions that ignore the observation are played, too: the baseline must succeed more often.
    Episode ``k`` of a task has the seed ``first_seed + k`` for every bundle, so that outcomes are paired.
    """

    films: ClassVar[bool] = True

    policy: Path | None = Field(None, description="policy.yaml (or its directory) that names environment and tasks")
    environment: str = Field("", description="path.py:make or package.module:make; the one in policy.yaml when empty")
    tasks: tuple[str, ...] = Field((), description="tasks; those in policy.yaml when empty")
    episodes: int = Field(200, ge=1, description="episodes over all tasks, spread evenly")
    first_seed: int = Field(EVALUATION_SEEDS, ge=0, description="seed of the first episode of every task")
    baseline: Path | None = Field(None, description="bundle to pair with, usually float32")
    control: Literal["", "random", "constant"] = Field(
        "", description="actions that ignore the observation, instead of the policy's: shows what succeeds by chance"
    )
    instruction: Literal["right", "wrong"] = Field("right", description="wrong: the control that a policy must fail")
    engine: str = Field("", description="engine of the runtime; the one that each bundle was made for when empty")
    limit: float | None = Field(
        None, ge=0, lt=1, description="stop when it is decided whether the drop is above this share (0.03 = 3 points)"
    )
    disturb: tuple[str, ...] = Field(
        (),
        description="disturbances to play as well: all, or some of delay, dropped_frames and the environment's own, "
        "such as light,delay",
    )
    strength: tuple[float, ...] = Field(
        (1.0,),
        min_length=1,
        description="strength of the disturbances, or several, such as 0.5,1,2; 1 is ordinary operation",
    )
    latency_in_the_loop: bool = Field(False, description="delay actions by the time that inferences take")
    environment_timeout: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="seconds that a call of the environment may take; when 0, the limit in policy.yaml, or 300",
    )
    controller: tuple[str, ...] = Field(
        (),
        description="controller that plays the chunks, and wrappers, with options: chunked, late, rtc:delay=8, "
        "temporal-ensemble, or those of other packages, such as smooth,late; when not given, late with "
        "--latency-in-the-loop, and chunked without",
    )
    board: str = Field(
        "", description="profile whose predicted latency that is; --profile sets it; measured here when empty"
    )

    @field_validator("disturb", "controller", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """Names may follow each other with commas, as strengths do."""
        given = [value] if isinstance(value, str) else value
        if not isinstance(given, list | tuple) or not all(isinstance(part, str) for part in given):
            return value
        return tuple(name.strip() for part in given for name in part.split(","))

    @field_validator("strength", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return [value] if isinstance(value, int | float) else value
        try:
            return [float(part) for part in value.split(",")]
        except ValueError:
            message = "numbers, such as 1 or 0.5,1,2, are allowed"
            raise PydanticCustomError("strength", message) from None

    @field_validator("strength")
    @classmethod
    def _in_order(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not all(0 <= strength <= STRONGEST for strength in value):
            raise PydanticCustomError("strength", f"Each strength must be from 0 to {STRONGEST}")
        return tuple(sorted(set(value)))

    def inputs(self) -> tuple[Path, ...]:
        """The baseline's manifest, and the environment's file with its neighbours, which it may import."""
        described = describe(self.policy) if self.policy else None
        where = self.environment or str((described.environment if described else {}).get("make", ""))
        folder = described.folder if described else Path()
        file = folder / where.rpartition(":")[0]
        code = sorted(file.parent.glob("*.py")) if file.is_file() else []
        return (*([self.baseline / MANIFEST] if self.baseline else []), *code)

    def key(self, source_hash: str) -> str:
        """A limit in time decides no outcome: what is finished of a run counts under another one, too."""
        default = type(self).model_fields["environment_timeout"].default
        if self.environment_timeout != default:
            return self.model_copy(update={"environment_timeout": default}).key(source_hash)
        return super().key(source_hash)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Environment and tasks are named, the environment may run, and options have something that they are of."""
        if self.limit is not None and (not self.baseline or self.control):
            raise UsageError("--limit is the largest drop against a baseline, and none is named.", "add --baseline DIR")
        if self.board and not self.latency_in_the_loop:
            raise UsageError("--board says whose latency counts, and none does.", "add --latency-in-the-loop")
        needless = [name for name in ("latency_in_the_loop", "controller") if self.control and getattr(self, name)]
        for option in (f"--{name.replace('_', '-')}" for name in needless):
            message = f"{option} is of inferences, and {self.control} actions need none."
            raise UsageError(message, f"leave {option} or --control out")
        layers(self.controller, delayed=self.latency_in_the_loop)
        _refuse_real_time(self.controller)
        if source is not None and not self.control:
            build_controller(_Unopened(source.manifest), self.controller, int(self.latency_in_the_loop))
        if "strength" in self.options() and not self.disturb:
            raise UsageError("--strength is of disturbances, and none is named.", "add --disturb all")
        jobs = self._jobs(source)
        self._may_run(jobs[0])
        if source is not None and self.limit is not None and (seen := seen_in_training(self._bundles(source), jobs)):
            raise UsageError(f"Nothing can be decided: {seen[0]}.", FIX)

    def _bundles(self, source: Bundle) -> list[Bundle]:
        return [*([Bundle.open_lazily(self.baseline)] if self.baseline else []), source]

    def on(self, board: Profile | None) -> Self:
        """Return the evaluation with the latency that is predicted for a board, where latency counts."""
        named = board is not None and self.latency_in_the_loop and not self.board
        return self.model_copy(update={"board": board.name}) if board and named else self

    def run(self, source: Bundle, context: Context) -> Report:
        """Run all episodes of the bundle, and of the baseline when there is one.

        What is finished is stored until the report is written, where there is a folder for that (``Context.work``).
        """
        notes: list[str] = []
        with Store.open(Path(context.work)) if context.work else contextlib.nullcontext() as store:
            report = self._measured(source, replace(context, note=notes.append), store)
        if store and store.taken:
            notes.append(f"{store.taken} of the {store.asked} episodes are of an interrupted run of the same command.")
        if store and store.problem:
            notes.append(store.problem)
        notes = list(dict.fromkeys(notes))
        for note in notes:
            context.note(note)
        return replace(report, warnings=(*report.warnings, *notes))

    def _measured(self, source: Bundle, context: Context, store: Store | None) -> Report:
        jobs = self._jobs(source)
        self._may_run(jobs[0])
        kinds = self._disturbances(source, jobs[0], context)
        bundles = [*([Bundle.open(self.baseline)] if self.baseline else []), source]
        names = names_of(bundles)
        check_video_of(bundles, jobs[0], context)
        if self.baseline:
            check_opens(bundles, jobs[0], self.engine, context)
        latencies = [loop_latency(one, self.board, self.engine, context, store) if self.latency_in_the_loop else None
                     for one in bundles]  # fmt: skip

        def run(bundle: Bundle, jobs: list[EpisodesJob], whose: str) -> list[Outcome]:
            return run_jobs(bundle, jobs, self.engine, context.about(whose), store=store)

        plays: list[Player] = []
        told_by = [context.about(whose) for whose in self._whose(names)]
        for one, latency, teller in zip(bundles, latencies, told_by, strict=True):
            most = sum(len(job.seeds) for job in jobs)
            plays.append(Player(one, latency, self.engine, teller, most, plays[0] if plays else None, store))
        rows: list[Row] = []
        believed, decision = Credibility(), None
        if self.baseline and self.limit is not None:
            first, outcomes, decision = played_until(jobs, self.limit, plays[0], plays[1], context)
            reference = [first]
            jobs = jobs_for(jobs[0], list(dict.fromkeys(job.task for job in jobs)), decision.pairs, self.first_seed)
        else:
            *reference, outcomes = (play(jobs) for play in plays)
        if self.baseline:
            rows.append(self._reference(bundles[0], names[0], reference[0], run))
            believed = credibility(rows[0]) if self.instruction == "right" else believed
        row = success_row(names[-1], "subject", outcomes)
        row = compare_success(rows[0], row) if rows else row
        row = with_decision(row, decision) if decision else row
        if kinds:
            played = [self._disturbed(kinds, with_latency(jobs, latency), one, whose, run)
                      for one, latency, whose in zip(bundles, latencies, self._whose(names), strict=True)]  # fmt: skip
            row = with_disturbed(row, played[-1], played[0] if self.baseline else None)
            for note in without_effect(names[-1], played[-1], outcomes):
                context.note(note)
        again = played_again(jobs[0], [*reference, outcomes], plays, bundles, context)
        if again.outcomes:
            rows, row = [with_episode(rows[0], again.outcomes[0])], with_episode(row, again.outcomes[1])
        rows = [with_derived(replace(row, measurements=(*row.measurements, latency)) if latency else row)
                for row, latency in zip([*rows, row], latencies, strict=True)]  # fmt: skip
        rows = [with_identity(row, bundle) for row, bundle in zip(rows, bundles, strict=True)]
        row = rows[-1]
        count = len(outcomes)
        how = "" if self.instruction == "right" else " told the wrong instruction"
        title = f"{source.manifest.name}{how} in {count} closed-loop episodes"
        how = f" with {self.control} actions in the place of the policy's" if self.control else how
        how += f" with the controller {','.join(self.controller)}" if self.controller else ""
        text = f"{row.value(SUCCESS):.1%} of {count} episodes succeed{how and ',' + how}."
        verdict = "inconclusive" if believed.fails else decision.verdict if decision else "info"
        decided = (sentence(decision, distinct_starts(row.raw[series.START])),) if decision else ()
        summary = (*believed.sentences, *decided, text, *sentences(rows, self.board), *again.sentences)
        doubts = (*repeated_starts(row), *seen_in_training(bundles, jobs), *found_wrong(source))
        warnings = (*believed.warnings, *doubts, *again.warnings)
        return Report("evaluate", title, verdict, summary, tuple(rows), environment=fingerprint(), warnings=warnings)

    def _disturbances(self, source: Bundle, job: EpisodesJob, context: Context) -> tuple[str, ...]:
        """Return the requested disturbances; raises UsageError for one that neither evaluation nor environment has."""
        if not self.disturb:
            return ()
        known = disturbances_of(source, job, context)
        if unknown := [kind for kind in self.disturb if kind not in (*known, ALL)]:
            raise UsageError.unknown(f"There is no disturbance '{unknown[0]}'", unknown[0], (*known, ALL))
        return known if ALL in self.disturb else tuple(dict.fromkeys(self.disturb))

    def _whose(self, names: Sequence[str]) -> list[str]:
        """Return whose episodes are told of, for each variant; nothing for one alone."""
        if self.control:
            return [f"the control, {self.control} actions"] * len(names)
        if len(names) < 2:
            return [""]
        base = f"the {BASELINE}" if names[0] == BASELINE else f"{names[0]}, the {BASELINE}"
        return [base, names[-1]]

    def _disturbed(
        self, kinds: Sequence[str], jobs: list[EpisodesJob], bundle: Bundle, whose: str, run: Run
    ) -> dict[tuple[str, float], list[Outcome]]:
        """Return disturbance and strength -> the episodes of a bundle under it."""
        played = {}
        for kind, strength in product(kinds, self.strength):
            under = f"under {kind}, strength {strength:g}"
            disturbed = [replace(job, disturb=kind, strength=strength) for job in jobs]
            played[kind, strength] = run(bundle, disturbed, f"{whose}, {under}" if whose else under)
        return played

    def _reference(self, baseline: Bundle, name: str, outcomes: list[Outcome], run: Run) -> Row:
        """Return the row of the baseline's episodes; play the controls that show what succeeds by chance."""
        row = success_row(name, "baseline", outcomes)
        if self.instruction != "right":
            return row
        controls = []
        for control in self.controls():
            (whose,) = control._whose([name])
            played = run(baseline, control._jobs(baseline), whose)
            controls.append(success_row(control.control, "subject", played))
        return with_chance(row, controls)

    def controls(self) -> list[ClosedLoop]:
        """Return the evaluations that show what succeeds by chance, on the first of the same seeds."""
        less = {"episodes": self._few(), "baseline": None, "disturb": (), "latency_in_the_loop": False, "limit": None,
                "controller": ()}  # fmt: skip
        return [self.model_copy(update={"control": control, **less}) for control in CONTROLS]

    def told_wrong(self) -> ClosedLoop:
        """Return the evaluation of as many episodes in which the policy is told the wrong instruction."""
        less = {"episodes": self._few(), "baseline": None, "disturb": (), "limit": None}
        return self.model_copy(update={"instruction": "wrong", **less})

    def _few(self) -> int:
        return min(self.episodes, max(CONTROL_EPISODES, self.episodes // 10))

    def _may_run(self, job: EpisodesJob) -> None:
        """Let the environment's code run if named in the options; raises SourceError for untrusted code of a bundle."""
        where, function = split_factory(job.environment)
        file = factory_file(job.environment, Path(job.folder))
        if self.environment and file is not None and not file.is_file():
            raise SourceError(
                f"No such file: {file} (--environment {self.environment}).",
                f"name it relative to {Path(job.folder).resolve()}, or by its full path",
            )
        if self.policy or self.environment:
            if file or self.policy:  # a package that is named makes no code of the current directory run
                trust.allow(file.parent if file else Path(job.folder))
            return
        if file is None:
            raise SourceError(
                f"This would run {function}() of the package {where}, which the bundle names and you did not.",
                "pass --policy DIR, or --environment and --tasks",
            )
        trust.require(file.parent, f"{function}() of {file.name}")

    def _scene(self, source: Bundle | None) -> dict[str, Any]:
        """Return the environment that the baseline names, or the bundle where there is none, or it names nothing.

        Raises:
            DataError: when both name one, and what would be played differs: a variant cannot choose its own.
        """
        own = source.manifest.environment if source else {}
        base = Bundle.open_lazily(self.baseline).manifest.environment if self.baseline else {}
        asked = {"make": self.environment, "tasks": self.tasks}
        other = [key for key, value in asked.items() if own and base and not value and own.get(key) != base.get(key)]
        if other:
            words = "; ".join(f"{key} {own.get(key)!r}, the baseline {base.get(key)!r}" for key in other)
            raise DataError(
                f"The bundle names another environment than its baseline: {words}.",
                "say which one is played: --policy DIR, or --environment FILE.py:make --tasks NAME",
            )
        return base or own

    def _jobs(self, source: Bundle | None) -> list[EpisodesJob]:
        described = describe(self.policy) if self.policy else None
        named = described.environment if described else self._scene(source)
        known = tuple(named.get("tasks", ()))
        tasks = self.tasks or known
        where = self.environment or str(named.get("make", ""))
        folder = described.folder if described else Path()
        if not where or not tasks:
            raise DataError(
                "No environment or no tasks are named for the closed loop.",
                "pass --policy DIR (with a policy.yaml that names them), or --environment FILE.py:make --tasks NAME",
            )
        if described is None and not self.environment and not (factory_file(where, folder) or folder).exists():
            raise DataError(
                f"The bundle names the environment {where}, which is not here.",
                "pass --policy DIR, the directory of the policy that the bundle was made from",
            )
        for task in self.tasks:
            if known and task not in known and not self.environment:
                raise UsageError.unknown(f"There is no task '{task}'", task, known)
        timeout = self.environment_timeout or timeout_of(named)
        job = EpisodesJob(where, str(folder), "", (), self.instruction, self.control,
                          controller=self.controller, timeout_s=timeout)  # fmt: skip
        return jobs_for(job, tasks, self.episodes, self.first_seed)


def _refuse_real_time(controllers: Sequence[str]) -> None:
    """Refuse controllers whose actions depend on the speed of this machine; raises UsageError naming the first."""
    for entry, options in options_of(controllers).items():
        beside = next((name for name in ("background", "thread") if options.get(name)), "")
        if beside or entry is Deadline:
            what = f"a {entry.__name__} with {beside}=true" if beside else "a deadline"
            raise UsageError(
                f"What {what} does depends on the speed of this machine, which says nothing of a robot.",
                "give the delay in control steps, such as rtc:delay=8, or in inferences, such as "
                "dual_rate:every=4:late=2, or add --latency-in-the-loop",
            )


class _Unopened:
    """A policy of which the manifest alone is known, with which controllers check their options."""

    def __init__(self, manifest: Manifest) -> None:
        self.spec, self.program = manifest.spec, manifest.program
        self.slow = slow_part(manifest.program)
        self.names = tuple(tensor.name for tensor in manifest.spec.inputs)
        self.noise = set[str]()

    def parts(self) -> tuple[_Unopened, _Unopened]:
        return self, self

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Action:
        raise NotImplementedError

    def observe(self, observation: Mapping[str, Any]) -> None:
        pass

    def reset(self, seed: int | None = None) -> None:
        pass
