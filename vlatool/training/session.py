"""One training: rounds of episodes and labels, and the steps between them."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import BEGINS, Recording, kept_rows, recorded_observations
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import jobs_for
from vlatool.errors import require
from vlatool.files.user_files import atomic_file
from vlatool.module.edits import read_edits
from vlatool.module.stage import write_changed
from vlatool.runtime.observation import ObservationEncoder
from vlatool.stage.base import Context
from vlatool.training.batches import Batches, draw_of, mean_loss
from vlatool.training.control import exchange_labels
from vlatool.training.crew import Crew
from vlatool.training.events import Events
from vlatool.training.expert import Expert, at_most
from vlatool.training.forecast import Forecast
from vlatool.training.frames import joined
from vlatool.training.held_out import HeldOut
from vlatool.training.lesson import Lesson
from vlatool.training.loop import Settings, Trainer
from vlatool.training.rounds import Counted, label, next_round, scene_of, write_recorded
from vlatool.training.sequences import episode_begins
from vlatool.training.supervision import TEACHER_ALONE, Supervision, parameters
from vlatool.training.teacher import Teacher
from vlatool.training.unseen import KEY, MOST, unseen_losses
from vlatool.training.yielded import write_yielded

ROUND = "round-{:03d}.json"
"""File that says who acted in a round, and how well."""
ALONG = "along"
"""Of the first round: how far a student that keeps values was from its teacher over whole episodes of it."""
RECORDED = 100_000
"""Recorded observations at most."""


@dataclass(frozen=True)
class Plan:
    """What is played when.

    Args:
        batch: Observations in a step.
        episodes: That the teacher plays first, over all tasks.
        student_episodes: That the student plays at each pause.
        pauses: Numbers of the steps before which it does.
        noise: What disturbs the actions in them, see ``EpisodesJob``.
        first_seed: Of the first episode of each task; the others follow.
        patience: Pauses in a row without an improvement after which training ends; 0 for never.
        accumulate: Parts of a batch, computed one after the other.
        yielded: Rows that are taken from the function of the policy's that yields batches.
        supervision: Who says what is right.
    """

    batch: int
    episodes: int
    student_episodes: int
    pauses: Sequence[int]
    noise: float
    first_seed: int
    patience: int = 0
    accumulate: int = 1
    yielded: int = 0
    supervision: Supervision = TEACHER_ALONE

    def asked(self, number: int) -> int:
        """Return how many episodes a round has."""
        return self.student_episodes if number else self.episodes

    def seed(self, number: int, tasks: int) -> int:
        """Return the seed of the first episode of a round."""
        return self.first_seed + sum(-(-self.asked(before) // tasks) for before in range(number))


class Session:
    """Trains a student; what was done is kept in a folder, from which a run that was killed goes on.

    Args:
        plan: What is played when.
        settings: How long and how fast is trained.
        lesson: What is trained.
        source: The student's bundle.
        teacher: Who says what is right.
        place: The folder.
        context: For progress.
        crew: Other processes that train, too.
    """

    def __init__(
        self,
        plan: Plan,
        settings: Settings,
        lesson: Lesson,
        source: Bundle,
        teacher: Teacher,
        place: Path,
        context: Context,
        crew: Crew | None = None,
    ) -> None:
        self._plan, self._settings, self._lesson = plan, settings, lesson
        self._source, self._teacher, self._place, self._context = source, teacher, place, context
        self._crew = crew or Crew()
        self._spec = source.manifest.spec
        self._scene = scene_of(source) if plan.episodes or plan.student_episodes else None
        self._plays = self._scene is not None and plan.student_episodes > 0
        self._encode = ObservationEncoder(self._spec, source)
        self._frames = lesson.frames(place)
        self._along = lesson.unroll is not None or bool(teacher.program.kept)
        self._held_out = HeldOut(place, lesson.frames) if plan.patience and not self._plays else None
        with self._crew.calling("prepare", {}):
            self._trainer = Trainer(lesson.trained, settings, place, self._crew.group, lesson.constraint)
        self._batches = Batches(lesson.loss, self._frames, plan.batch, plan.accumulate, self._crew.group)
        self._expert = Expert(place, lesson.frames)
        self._draw = draw_of(self._batches, plan.supervision.alpha, lesson.expert, self._expert.frames)
        self._forecast = Forecast(settings.steps, self._trainer.step)
        self._events = Events(context.events, self._trainer.step)
        self._success = ""

    def run(self) -> dict[str, Any]:
        """Play, label and train until all steps are done; return what there is to know of it."""
        if self._trainer.step:
            self._context.tell(f"going on from step {self._trainer.step}", None)
        if self._held_out is not None:
            self._held_out.prepare(self._recorded(), self._write_held_out, self._yield_held_out)
        self._show()
        if self._plan.supervision.alpha:
            next_round(self._frames, 0, self._first)
            self._compare("before")
        pauses = self._plan.pauses if self._plays or self._held_out is not None else ()
        for number, end in enumerate([*pauses, self._settings.steps]):
            if number and self._paused(number):
                break
            self._train(end)
        else:
            if self._plan.patience:
                self._paused(len(pauses) + 1)
        with self._all("finish"):
            self._trainer.finish()
        self._compare("after")
        self._events.close()
        return self._about()

    def observations(self, most: int) -> dict[str, Any]:
        """Return rows of the inputs, spread over all rounds, fewer where they are large: name -> (N, ...)."""
        names = [tensor.name for tensor in self._spec.inputs]
        first = self._frames.rows(np.zeros(1, int))
        held = self._frames.kept(kept_rows(most, sum(first[name].nbytes for name in names)))
        return {name: held[name] for name in (*names, BEGINS) if name in held}

    def _show(self) -> None:
        """Write what the expert did, to learn from and to judge with, where the expert is asked."""
        if self._lesson.expert is None:
            return
        chosen = self._plan.supervision.label_share, self._settings.seed
        if self._held_out is None:
            self._expert.prepare(self._recorded(), self._source, *chosen, self._encode)
            return
        self._expert.prepare(self._held_out.others, self._source, *chosen, self._encode)
        self._held_out.expert.prepare(self._held_out.recording, self._source, *chosen, self._encode)

    def _recorded(self) -> Recording | None:
        """Return what is recorded, whole episodes where student or teacher keep values."""
        return at_most(self._source, RECORDED, whole=self._along)

    def _compare(self, when: str) -> None:
        """Note how far a student that keeps values is from its teacher over whole episodes, and not in windows."""
        if self._lesson.unroll is None or not self._frames.count:
            return
        about = self._round(0)
        if when == "after" or not self._trainer.step:
            places = self._frames.sample((0,), MOST)
            how = self._lesson.examined, self._plan.batch, self._settings.device
            counts = {"episodes": len(places), "observations": self._frames.weigh(places)}
            cut = {} if self._lesson.unroll.burn_in is None else {"burn_in": self._lesson.unroll.burn_in}
            far = {when: mean_loss(self._frames, places, *how)}
            about[ALONG] = {**about.get(ALONG, {}), **counts, **cut, **far}
            self._keep(0, about)

    def _train(self, end: int) -> None:
        with self._crew.training(self._frames.count, len(self._frames), end):
            self._trainer.look(partial(self._lesson.look, self._frames, self._expert.frames))
            self._trainer.train(end, self._draw, self._tell)
            self._trainer.save()

    def _all(self, function: str, **job: Any) -> contextlib.AbstractContextManager[None]:
        """Let the other processes do the same within the block, where each holds a part of the weights."""
        return self._crew.calling(function, job) if self._settings.shard else contextlib.nullcontext()

    def _paused(self, number: int) -> bool:
        """Let the student play, and say whether it has stopped getting better."""
        if self._plays:
            with self._forecast.pause():
                next_round(self._frames, number, partial(self._students, number))
                self._try(number)
            self._note(number)
        patience, best = self._plan.patience, self._trainer.best
        if not patience:
            return False
        if len(best.scores) < number:
            score = self._score(number)
            with self._all("judge", score=score):
                self._trainer.judge(score)
                self._trainer.save()
        return best.unimproved(number) >= patience

    def _try(self, number: int) -> None:
        """Note how far the student is from its teacher in the round that it has just played, before it trains on it."""
        about = self._round(number)
        if KEY in about or about["step"] != self._trainer.step or self._settings.shard:
            return  # an earlier run did, or cannot: the weights of then are gone
        how = self._lesson.loss, self._plan.batch, self._settings.device
        with self._trainer.averaged():
            about[KEY] = unseen_losses(self._frames, number, *how)
        self._events.add(about["step"], {f"loss on {name} rows": loss for name, loss in about[KEY].items()})
        self._keep(number, about)

    def _score(self, number: int) -> float:
        """Return how well the averaged weights do: the share of episodes that succeed, or less the held-out loss."""
        if self._held_out is None:
            about = self._round(number)
            return float(about["successes"] / about["episodes"])
        with self._all("examine"), self._trainer.averaged():
            terms = self._plan.supervision.alpha, self._lesson.examined, self._lesson.expert
            loss = self._held_out.mixed(*terms, self._plan.batch, self._settings.device)
        self._events.add(self._trainer.step, {"held-out loss": loss})
        self._success = f"held-out loss {loss:.4g}"
        return -loss

    def _about(self) -> dict[str, Any]:
        best, several, device = self._trainer.best, self._crew.group.size, self._settings.device
        supervision, teacher = self._plan.supervision, self._teacher.program.modules
        judged = "success" if self._held_out is None else "held-out loss"
        scores = best.scores if self._held_out is None else [-score for score in best.scores]
        return {
            "loss": supervision.loss_name(self._lesson.name),
            **self._lesson.about,
            "precision": device.precision,
            **({"device": device.name} if device.name != "cpu" else {}),
            "threads": require("torch", "build").get_num_threads(),
            **({"processes": several} if several > 1 else {}),
            "losses": self._trainer.losses,
            "rounds": [self._round(number) for number in range(self._frames.count)] or [self._expert.round()],
            "parameters": {"student": parameters(self._lesson.modules), "teacher": parameters(teacher)},
            "teacher": supervision.about(self._trainer.looks, self._expert.counts),
            **({"along": self._round(0)[ALONG]} if self._lesson.unroll and self._frames.count else {}),
            **({"judged": {"by": judged, "scores": scores, "best_step": best.step}} if scores else {}),
        }

    def _round(self, number: int) -> dict[str, Any]:
        about: dict[str, Any] = json.loads((self._place / ROUND.format(number)).read_text())
        return about

    def _keep(self, number: int, about: dict[str, Any]) -> None:
        with atomic_file(self._place / ROUND.format(number)) as draft:
            draft.write_text(json.dumps(about))

    def _note(self, number: int) -> None:
        """Remember for the progress how well the student did."""
        about = self._round(number)
        share = about["successes"] / about["episodes"]
        self._success = f"student {share:.1%} of {about['episodes']}"
        self._events.add(about["step"], {"success": share})

    def _write_held_out(self, observations: Counted, target: Path) -> None:
        self._write(observations, target)
        self._label(target, 0, 1)

    def _write(self, observations: Counted, target: Path) -> None:
        """Write recorded observations, and where their episodes begin where that matters."""
        begins = episode_begins(observations) if self._along and isinstance(observations, Recording) else None
        write_recorded(self._encode, observations, target, begins)

    def _yield_held_out(self, target: Path) -> bool:
        """Write rows to judge with that the policy's function yields; say whether it does."""
        if self._plan.yielded:
            self._yield(-(-self._plan.yielded // 10), self._settings.seed + 1, target)
            self._label(target, 0, 1)
        return bool(self._plan.yielded)

    def _yield(self, count: int, seed: int, target: Path) -> None:
        write_yielded(self._source, count, seed, target, self._context, along=self._along)

    def _first(self, target: Path) -> None:
        """Write the first round: recordings, batches of the policy's own, and the teacher's episodes."""
        recorded = (self._recorded() or []) if self._along else recorded_observations(self._source, RECORDED)
        chosen = self._held_out.others if self._held_out is not None else recorded
        self._write(chosen, target / "recorded")
        if self._plan.yielded:
            self._yield(self._plan.yielded, self._settings.seed, target / "yielded")
        self._play(target, 0)

    def _students(self, number: int, target: Path) -> None:
        """Write a round of the student's episodes; its averaged weights act."""
        with self._trainer.averaged():
            self._play(target, number)

    def _play(self, target: Path, number: int) -> None:
        folder, episodes = target / "episodes", self._plan.asked(number)
        who = "student" if number else "teacher"
        about: dict[str, Any] = {"step": self._trainer.step, "actor": who}
        if self._scene is not None and episodes:
            self._context.tell(f"the {who} plays {episodes} episodes", None)
            scene, tasks = self._scene
            jobs = [
                replace(job, noise=self._plan.noise, record=str(folder / f"{place:05d}"))
                for place, job in enumerate(jobs_for(scene, tasks, episodes, self._plan.seed(number, len(tasks))))
            ]
            outcomes = run_jobs(self._actor(target / "actor", number), jobs, "", self._context)
            about |= {"episodes": len(outcomes), "successes": sum(outcome.success for outcome in outcomes)}
        about |= {"yielded": self._plan.yielded} if self._plan.yielded and not number else {}
        about["observations"] = joined((target / "recorded", target / "yielded", *sorted(folder.glob("*"))), target)
        for part in ("recorded", "yielded", "episodes", "actor"):
            shutil.rmtree(target / part, ignore_errors=True)
        self._keep(number, about)
        self._label(target, number)

    def _label(self, target: Path, *seed: int) -> None:
        if not self._plan.supervision.alpha:
            return
        names = [tensor.name for tensor in self._spec.inputs]
        outputs = [tensor.name for tensor in self._spec.outputs]
        with self._settings.device.computing():
            seeds = (self._settings.seed, *seed)
            teacher, turns = self._teacher.program, self._lesson.turns
            labels = label(target, names, outputs, teacher, seeds, self._context, turns=turns)
        if self._plan.supervision.control == "noise":
            exchange_labels(target, labels, seeds)

    def _actor(self, place: Path, number: int) -> Bundle:
        """Write who plays as a bundle, which the processes that play open."""
        place.mkdir()
        source, teacher = self._source, self._teacher
        if number:
            with self._all("show"), self._trainer.whole():
                return write_changed(source, place, read_edits(source), self._lesson.modules, source.manifest.made_by)
        modules = teacher.program.modules
        program = teacher.program.steps
        return write_changed(teacher.bundle, place, teacher.edits, modules, source.manifest.made_by, program=program)

    def _tell(self, step: int, loss: float) -> None:
        words = [f"step {step} of {self._settings.steps}", f"loss {loss:.4g}", self._success, self._forecast.left(step)]
        self._context.tell(", ".join(filter(None, words)), step / self._settings.steps)
        self._events.add(step, {"loss": self._trainer.losses[-1], "learning rate": self._settings.rate(step - 1)})
