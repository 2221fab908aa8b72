"""The trials of ``optimize`` in an Optuna study: what is tried next, and what was found, also by other machines."""

from __future__ import annotations

import math
import os
import platform
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import psutil

from vlatool.errors import DataError, VlatoolError, require
from vlatool.optimize.recipe import StageList
from vlatool.optimize.space import FLOAT32, Shape, Space, quantizations
from vlatool.optimize.study_storage import storage_errors, storage_of

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial, Trial

STARTUP = 6
"""Trials after which what was found says what is tried next; before, the first shapes, then random ones."""
REMEDY = "take a study that vlatool made, or a new one: another --study"
QUANTIZED_KEY = "quantized"
NOTE_KEY, AGAIN_KEY, WORKER_KEY, TRAINING_KEY, REFUSED_KEY = "note", "again", "worker", "training_s", "refused"
REPEATS = 10
"""Shapes that are drawn in the hope of one that was not tried yet; after that, the first such one is taken."""
LONGEST = 400
"""Characters of a note."""


@dataclass(frozen=True)
class Tried:
    """What a trial found.

    Args:
        speedup: Against the whole policy in float32; 0 when it could not be made.
        drop: Accuracy lost, a share of episodes or in the measure of the budget; infinite when not known.
        training_s: Seconds that its training took, wherever that was; 0 for none.
        elsewhere: Whether another machine or process tried it, so that all of this is what the study says.
        refused: Why it moves worse than the limits allow, or loses more on one task; empty when it does not.
        miss: By how much, as a multiple of the limits.
    """

    shape: Shape
    speedup: float = 0.0
    drop: float = math.inf
    training_s: float = 0.0
    note: str = ""
    elsewhere: bool = False
    refused: str = ""
    miss: float = 0.0


class Study:
    """One Optuna study: ask for a shape, tell what it gave.

    Args:
        url: ``sqlite:///FILE``, ``mysql://``, ``postgresql://``, or a file for a journal.
        name: Of the study; trials of other policies or limits have another.
        allowed: Drop that a shape may have.

    Raises:
        UsageError: when it cannot be opened.
        MissingExtra: without Optuna.
    """

    def __init__(self, url: str, name: str, allowed: float, seed: int) -> None:
        self._optuna = require("optuna", "search")
        self._optuna.logging.set_verbosity(self._optuna.logging.ERROR)
        self._allowed, self._seed = allowed, seed
        self._worker = worker()
        self._left: list[int] = []
        self._told: dict[int, Tried] = {}
        self._space = Space((1.0,), 1, 1, {}, ())
        self._url = url
        with storage_errors(url):
            storage = storage_of(url)
            self._study = self._optuna.create_study(
                storage=storage, study_name=name, directions=["maximize", "minimize"], load_if_exists=True
            )

    def agree_on(self, quantized: Mapping[str, StageList]) -> dict[str, StageList]:
        """Return how all who share the study quantize, as the first of them found; raises DataError for other data."""
        with storage_errors(self._url):
            if QUANTIZED_KEY not in self._study.user_attrs:
                self._study.set_user_attr(QUANTIZED_KEY, [[name, list(stages)] for name, stages in quantized.items()])
            held = self._study.user_attrs[QUANTIZED_KEY]
        try:
            agreed = {str(name): tuple(stages) for name, stages in held}
            known = quantizations(agreed)
        except (AttributeError, TypeError, ValueError, VlatoolError) as error:
            raise DataError(f"The study says of quantization what vlatool cannot read: {error}.", REMEDY) from error
        if known != agreed or FLOAT32 in agreed:
            raise DataError("The study names stages that do not quantize.", "name another study")
        return {**agreed, FLOAT32: ()}

    def begin(self, space: Space) -> None:
        """Say what may be chosen, and take up what a process of this machine left when it was killed."""
        self._space = space
        with storage_errors(self._url):
            for shape in space.first():
                self._study.enqueue_trial(asdict(shape), skip_if_exists=True)
            self._left = [trial.number for trial in self._trials() if self._is_left(trial)]

    def ask(self, trials: int) -> tuple[int, Shape] | None:
        """Return the number and shape of the next trial, None when so many are done or under way, or all was tried.

        Raises:
            DataError: when the study is of another space.
            UsageError: when it cannot be read or written any more.
        """
        with storage_errors(self._url):
            return self._next(trials)

    def _next(self, trials: int) -> tuple[int, Shape] | None:
        while self._left:
            if (taken := self._taken_up(self._left.pop(0), trials)) is not None:
                return taken
        for attempt in range(REPEATS + 1):
            counted = [trial.params for trial in self._trials() if self._counts(trial)]
            if len(counted) >= trials:
                return None
            if attempt == REPEATS:  # what was found leads to the same shapes again and again
                new = next((shape for shape in self._space.all() if asdict(shape) not in counted), None)
                if new is None:
                    return None
                self._study.enqueue_trial(asdict(new))
            number, shape = self._asked()
            if asdict(shape) not in counted:
                return number, shape
            self._drop(number)
        return None

    def _asked(self) -> tuple[int, Shape]:
        self._study.sampler = self._optuna.samplers.TPESampler(
            n_startup_trials=STARTUP, seed=self._seed + len(self._trials()), multivariate=True
        )
        trial, space = self._study.ask(), self._space
        trial.set_user_attr(WORKER_KEY, self._worker)
        try:
            shape = Shape(
                trial.suggest_categorical("width", space.widths),
                trial.suggest_int("blocks", 1, space.blocks),
                trial.suggest_int("steps", 1, space.steps, log=True),
                trial.suggest_categorical("quantized", tuple(space.quantized)),
            )
        except ValueError as error:
            raise DataError(f"The study's trials are of another space: {error}.", "name another study") from error
        return trial.number, shape

    def _drop(self, number: int) -> None:
        """End a trial that does not count."""
        self._trial(number).set_user_attr(AGAIN_KEY, True)
        self._study.tell(number, state=self._optuna.trial.TrialState.FAIL, skip_if_finished=True)

    def tell(self, number: int, tried: Tried) -> None:
        """Keep what a trial found, or why it could not be made; raises UsageError when the study cannot be written."""
        if tried.note or not (math.isfinite(tried.speedup) and math.isfinite(tried.drop)):
            note = tried.note[:LONGEST] or "its accuracy could not be measured"
            tried = Tried(tried.shape, training_s=tried.training_s, note=note)
        tried = self._told[number] = replace(tried, refused=tried.refused[:LONGEST])
        with storage_errors(self._url):
            trial = self._trial(number)
            trial.set_user_attr(TRAINING_KEY, tried.training_s)
            if tried.note:
                trial.set_user_attr(NOTE_KEY, tried.note)
                self._study.tell(number, state=self._optuna.trial.TrialState.FAIL)
            else:
                trial.set_user_attr(REFUSED_KEY, tried.refused)
                trial.set_constraint("drop", tried.drop - self._allowed)
                trial.set_constraint("moves", tried.miss)
                self._study.tell(number, [tried.speedup, tried.drop])

    def ended_trials(self) -> list[Tried]:
        """Return what is known of all trials that ended: what this object was told, and what the study says of others.

        Raises:
            DataError: when what the study holds is not what a trial finds.
        """
        with storage_errors(self._url):
            ended = [trial for trial in self._trials() if trial.state.is_finished() and self._counts(trial)]
            return [self._told.get(trial.number) or self._read(trial) for trial in ended]

    def under_way(self) -> int:
        """Return how many trials other processes have under way."""
        running = self._optuna.trial.TrialState.RUNNING
        with storage_errors(self._url):
            return sum(trial.state == running for trial in self._trials())

    def _trials(self) -> list[FrozenTrial]:
        trials: list[FrozenTrial] = self._study.get_trials(deepcopy=False)
        return trials

    def _counts(self, trial: FrozenTrial) -> bool:
        return trial.state != self._optuna.trial.TrialState.WAITING and not trial.user_attrs.get(AGAIN_KEY)

    def _trial(self, number: int) -> Trial:
        """Return a trial that may be written to."""
        trial: Trial = self._optuna.trial.Trial(self._study, self._trials()[number]._trial_id)
        return trial

    def _is_left(self, trial: FrozenTrial) -> bool:
        """Return whether a process of this machine had a trial under way when it was killed."""
        running = trial.state == self._optuna.trial.TrialState.RUNNING
        return running and _is_dead(str(trial.user_attrs.get(WORKER_KEY, "")))

    def _taken_up(self, number: int, trials: int) -> tuple[int, Shape] | None:
        """Go on with a trial that was left, before any other; None where it is not wanted, or taken."""
        trial = self._trials()[number]
        if not self._is_left(trial):
            return None
        done = sum(self._counts(other) and not self._is_left(other) for other in self._trials())
        if set(trial.params) != set(Shape.__dataclass_fields__):  # killed before it was chosen
            self._drop(number)
            return None
        if done >= trials:
            self._drop(number)
            self._study.enqueue_trial(trial.params)
            return None
        shape = Shape(**trial.params)
        if not self._space.holds(shape):
            raise DataError(f"The study's trials are of another space: {trial.params}.", "name another study")
        self._trial(number).set_user_attr(WORKER_KEY, self._worker)
        return number, shape

    def _read(self, trial: FrozenTrial) -> Tried:
        try:
            shape = Shape(**trial.params)
            speedup, drop = trial.values or (0.0, math.inf)
            seconds = float(trial.user_attrs.get(TRAINING_KEY, 0.0))
            note, refused = (str(trial.user_attrs.get(name, ""))[:LONGEST] for name in (NOTE_KEY, REFUSED_KEY))
        except (TypeError, ValueError) as error:
            raise DataError(f"Trial {trial.number} of the study is not a trial of vlatool: {error}.", REMEDY) from error
        if not self._space.holds(shape) or not speedup >= 0 or math.isnan(drop):
            raise DataError(
                f"Trial {trial.number} of the study is not of this policy: {trial.params}, {trial.values}.",
                "name another study",
            )
        return Tried(shape, speedup, drop, seconds, note, elsewhere=True, refused=refused)


def worker() -> str:
    """Return what tells this process from others that share a study: a machine, the process, when it began."""
    return f"{uuid.getnode():x}-{platform.node()}/{os.getpid()}/{psutil.Process().create_time():.0f}"


def _is_dead(other: str) -> bool:
    """Return whether a process of this machine is no more; of other machines nothing is known."""
    ours, theirs = worker().split("/"), other.split("/")
    if len(theirs) != len(ours) or theirs[0] != ours[0] or not theirs[1].isdecimal():
        return False
    try:
        began = psutil.Process(int(theirs[1])).create_time()
    except (psutil.NoSuchProcess, OverflowError):
        return True
    return f"{began:.0f}" != theirs[2]  # another process has its number now
