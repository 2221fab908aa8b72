"""Spread episodes over workers, take what an interrupted run left, and put all outcomes in order."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Generator, Iterator, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.accuracy.success_comparison import Outcome
from vlatool.bundle.bundle import DIGEST, MANIFEST, Bundle
from vlatool.data import recordings_of
from vlatool.episodes import play
from vlatool.episodes.content import circumstances, key_of
from vlatool.episodes.disturbances import BUILT_IN_DISTURBANCES
from vlatool.episodes.faults import locate, under_way
from vlatool.episodes.play import OUTCOME_PREFIX, PRELOAD, RECORDINGS, EpisodesJob, Played, Request
from vlatool.episodes.progress import Tally
from vlatool.errors import DataError, SourceError, VlatoolError
from vlatool.files.messages import from_json, to_json
from vlatool.files.resumable_work import Store
from vlatool.module.factory import factory_file
from vlatool.stage.base import Context
from vlatool.workers import PROCESSES, Folder, Work, launcher

OWN_FILES = "let the environment write to its own files alone, and run the command again"

PLAY_MODULE = play.__name__
Outcomes = tuple[Outcome, ...]


def run_jobs(
    bundle: Bundle, jobs: list[EpisodesJob], engine: str, context: Context, tally: Tally | None = None,
    store: Store | None = None
) -> list[Outcome]:  # fmt: skip
    """Play all episodes and return their outcomes in the order of the jobs, whoever plays them.

    Args:
        engine: engine of the runtime; the bundle's own when empty.
        context: Progress and workers.
        tally: Counts successes for the progress; one of these jobs alone when None.
        store: Outcomes of an interrupted run, and of this one; none are stored when None.

    Raises:
        DataError: when the environment fails or does not fit the policy's spec.
        SourceError: when it ends the process that it runs in.
        TargetError: when the machines of other workers cannot be used.
    """
    if not jobs:
        return []
    tally = tally or Tally(sum(len(job.seeds) for job in jobs))
    kept = _Kept(bundle, engine, jobs, context, store)
    missing = [number for number in range(len(jobs)) if number not in kept.found]
    played = _played(bundle, [kept.rest(number) for number in missing], engine, context, kept, missing)
    outcomes: list[Outcome] = []
    with contextlib.closing(played):
        for number in range(len(jobs)):
            part = kept.found[number] if number in kept.found else kept.whole(number, next(played))
            outcomes += part
            tally.add(part)
            context.progress(tally.sentence(), tally.share)
        next(played, None)  # what is open is closed
    kept.say()
    return outcomes


def _played(
    bundle: Bundle, jobs: list[EpisodesJob], engine: str, context: Context, kept: _Kept, numbers: Sequence[int]
) -> Generator[Outcomes, None, None]:
    """Yield the outcomes of jobs in order; each is kept as soon as it is there."""
    if not jobs:
        return
    alone = jobs[0].record or not bundle.manifest.graphs  # what is written, or imported, is on this machine
    name, count = (PROCESSES, 1) if alone and context.launcher != PROCESSES else (context.launcher, context.workers)

    def keep_answer(at: int, answer: Any) -> None:
        kept.put(numbers[at], kept.whole(numbers[at], outcomes_of(answer, jobs[at])))

    begun: set[str] = set()
    ours = {under_way(job.task, seed) for job in jobs for seed in job.seeds}

    def tell(what: str, share: float | None) -> None:
        if what.startswith(OUTCOME_PREFIX):
            kept.keep_outcome(what.removeprefix(OUTCOME_PREFIX))
        else:
            begun.add(what) if what in ours else context.progress(what, share)

    work = _work("play", bundle, jobs, engine, PRELOAD, "close", away=name != PROCESSES)
    answers = launcher(name, count).answers(work, tell, keep_answer, context.note)
    with contextlib.closing(answers):
        for job in jobs:
            with _located(job, begun, away=name != PROCESSES):
                answer = next(answers)
            yield outcomes_of(answer, job)
        next(answers, None)  # what is open is closed


@contextlib.contextmanager
def _located(job: EpisodesJob, begun: Set[str], *, away: bool) -> Iterator[None]:
    """Let what comes instead of the outcomes of a job name its task, and the seed that was under way."""
    try:
        yield
    except VlatoolError as error:
        seed = next((seed for seed in reversed(job.seeds) if under_way(job.task, seed) in begun), None)
        if seed is not None or isinstance(error, DataError | SourceError):
            known = seed is not None or any(f"seed {other}" in str(error.message) for other in job.seeds)
            seeds = f"(one of the seeds {job.seeds[0]} to {job.seeds[-1]})" if away and not known else ""
            locate(error, job.task, seed, seeds, (job.disturb, job.strength) if job.disturb else None)
        raise


def check_opens(bundles: Sequence[Bundle], job: EpisodesJob, engine: str, context: Context) -> None:
    """Refuse, before episodes are played, a bundle that cannot be: each is opened once, golden action and all.

    Args:
        engine: engine of the runtime; the bundle's own when empty.

    Raises:
        BundleError, GraphError: when a bundle was changed, or its engine computes something else here.
    """
    for bundle in bundles:
        name = context.launcher if bundle.manifest.graphs else PROCESSES
        work = _work("open_bundle", bundle, [job], engine, PRELOAD, away=name != PROCESSES)
        list(launcher(name, 1).answers(work, context.progress, lambda _number, _answer: None, context.note))


def disturbances_of(bundle: Bundle, job: EpisodesJob, context: Context) -> tuple[str, ...]:
    """Return the disturbances that can be played: those that need no environment, and its own.

    Raises:
        DataError: when the environment does not say properly which they are.
        SourceError: when it ends the process that it runs in.
    """
    work = _work("disturbances", bundle, [job], "", away=context.launcher != PROCESSES)
    who = launcher(context.launcher, context.workers)
    (own,) = who.answers(work, context.progress, lambda _number, _answer: None, context.note)
    if not isinstance(own, list) or not all(isinstance(kind, str) for kind in own):
        raise DataError(
            "The process that asked the environment for its disturbances did not answer with names.", OWN_FILES
        )
    return (*BUILT_IN_DISTURBANCES, *(kind for kind in own if kind not in BUILT_IN_DISTURBANCES))


def _work(
    function: str,
    bundle: Bundle,
    jobs: Sequence[EpisodesJob],
    engine: str,
    preload: Sequence[str] = (),
    last: str = "",
    *,
    away: bool = False,
) -> Work:
    path = str(bundle.path.absolute())
    folders: tuple[Folder, ...] = ()
    about = jobs[0].environment.rpartition(":")[0]
    if away:
        folders = (Folder(path, (MANIFEST, DIGEST, *_needed(bundle, jobs))), *_placed(jobs[0])[1])
        jobs = [_placed(job)[0] for job in jobs]
    requests = [to_json(Request(path, engine, play.STEP_LIMIT, job)) for job in jobs]
    return Work(f"{PLAY_MODULE}:{function}", requests, about, preload, last and f"{PLAY_MODULE}:{last}", folders)


def _needed(bundle: Bundle, jobs: Sequence[EpisodesJob]) -> list[str]:
    """Return the files of a bundle that its episodes read: of the recordings what controls and noise are drawn from."""
    drawn_from = recordings_of(bundle).calibration if any(job.control or job.noise for job in jobs) else None
    recorded = {name for name in bundle.manifest.files if name.startswith(RECORDINGS)}
    asked = {name for name in recorded if drawn_from and (bundle.path / name).is_relative_to(drawn_from)}
    return sorted({*bundle.manifest.files} - recorded | asked)


def _placed(job: EpisodesJob) -> tuple[EpisodesJob, tuple[Folder, ...]]:
    """Return a job that names its environment wherever it runs, and the folder that this lies in.

    A policy's folder is needed as a whole; where the file alone was named, the one that it is in.
    """
    folder = Path(job.folder)
    file = factory_file(job.environment, folder)
    if file is None:
        return job, ()
    if job.folder not in ("", ".") and file.is_relative_to(folder.resolve()):
        whole = folder.resolve()
        return replace(job, folder=str(whole)), (Folder(str(whole)),)
    function = job.environment.rpartition(":")[2]
    return replace(job, environment=f"{file}:{function}"), (Folder(str(file.parent)),)


def outcomes_of(answer: Any, job: EpisodesJob) -> Outcomes:
    """Return what is said of the episodes of a job: by a child, a worker elsewhere, or a file of an earlier run.

    Raises:
        DataError: when it is not of these episodes, or of what no episode can be like.
    """
    try:
        outcomes = from_json(Played, answer).outcomes
    except ValueError as error:
        raise DataError(
            f"The process that played '{job.task}' did not answer with episodes: {error}.", OWN_FILES
        ) from error
    if [(outcome.task, outcome.seed) for outcome in outcomes] != [(job.task, seed) for seed in job.seeds]:
        raise DataError(f"The process that played '{job.task}' answered with other episodes.", OWN_FILES)
    for outcome in outcomes:
        if why := _impossible(outcome, job):
            raise DataError(
                f"The process that played '{job.task}' answered with what no episode is like: {why}.", OWN_FILES
            )
    return outcomes


def _impossible(outcome: Outcome, job: EpisodesJob) -> str:
    """Return why no episode ends like that; nothing when one may."""
    if not 1 <= outcome.steps <= play.STEP_LIMIT:
        return f"{outcome.steps:.3g} steps (allowed: 1 to {play.STEP_LIMIT:,})"
    if len(outcome.instruction) > play.MAX_INSTRUCTION_LENGTH:
        return f"an instruction of {len(outcome.instruction):,} characters"
    if not all(map(math.isfinite, outcome.motion.values())):
        return "a motion that is infinite or NaN"
    return "steps that nobody asked for" if outcome.series and not job.show else ""


class _Kept:
    """The outcomes of an interrupted run of the same command, as far as nothing that decides them has changed."""

    def __init__(
        self, bundle: Bundle, engine: str, jobs: Sequence[EpisodesJob], context: Context, store: Store | None
    ) -> None:
        self.found: dict[int, Outcomes] = {}
        self._jobs = jobs
        self._single: dict[tuple[str, int], Outcome] = {}
        self._context = context
        self._store = None if jobs[0].record else store
        if self._store is None:
            return
        around = circumstances(bundle, engine, jobs[0])
        self._keys = [self._store.turn(key_of(around, job)) for job in jobs]
        for number, job in enumerate(jobs):
            found = self._found(self._keys[number], job)
            if found:
                self.found[number] = found
            elif len(job.seeds) > 1:
                self._look_for_each(number)
        taken = sum(map(len, self.found.values())) + len(self._single)
        self._store.taken += taken
        self._store.asked += sum(len(job.seeds) for job in jobs)
        if taken:
            context.progress(f"{taken} episodes are of an interrupted run", None)

    def _found(self, key: str, job: EpisodesJob) -> Outcomes:
        """Return what is kept of a job; nothing where there is none, or it is not what that job gives."""
        value = None if self._store is None else self._store.get(key)
        with contextlib.suppress(DataError):
            return () if value is None else outcomes_of(value, job)
        return ()

    def _look_for_each(self, number: int) -> None:
        """Take the first episodes of a job that was not finished."""
        job = self._jobs[number]
        for seed in job.seeds:
            found = self._found(self._key_of_one(number, seed), replace(job, seeds=(seed,)))
            if not found:
                return
            self._single[job.task, seed] = found[0]

    def _key_of_one(self, number: int, seed: int) -> str:
        return f"{self._keys[number]} seed {seed}"

    def rest(self, number: int) -> EpisodesJob:
        """Return what is to be played of a job: the episodes that are not there, one at least."""
        job = self._jobs[number]
        seeds = tuple(seed for seed in job.seeds if (job.task, seed) not in self._single)
        return replace(job, seeds=seeds or job.seeds)

    def whole(self, number: int, played: Outcomes) -> Outcomes:
        """Return the outcomes of a job in order, of which some were there."""
        job = self._jobs[number]
        own = {outcome.seed: outcome for outcome in played}
        return tuple(own.get(seed) or self._single[job.task, seed] for seed in job.seeds)

    def keep_outcome(self, text: str) -> None:
        """Keep an episode of a job that is not finished, as a child tells it."""
        if self._store is None:
            return
        with contextlib.suppress(ValueError, DataError):
            outcome = from_json(Outcome, json.loads(text))
            for number, job in enumerate(self._jobs):
                if job.task == outcome.task and outcome.seed in job.seeds:
                    value = to_json(Played((outcome,)))
                    outcomes_of(value, replace(job, seeds=(outcome.seed,)))
                    self._store.put(self._key_of_one(number, outcome.seed), value)

    def put(self, number: int, outcomes: Outcomes) -> None:
        """Keep the outcomes of a job as one, and no longer each."""
        if self._store is not None:
            self._store.put(self._keys[number], to_json(Played(outcomes)))
            for seed in self._jobs[number].seeds:
                self._store.drop(self._key_of_one(number, seed))

    def say(self) -> None:
        """Say it where outcomes cannot be kept."""
        if self._store is not None and self._store.problem:
            self._context.progress(self._store.problem, None)
