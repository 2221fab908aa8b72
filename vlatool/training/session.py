"""The course of a training: rounds of episodes and labels, and the steps between them."""

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
from vlatool.files.printable import amount
from vlatool.files.user_files import atomic_file
from vlatool.module.edits import read_edits
from vlatool.module.stage import ModuleChanges, write_modules
from vlatool.runtime.observation import ObservationEncoder
from vlatool.stage.base import Context
from vlatool.training.batches import Batches, draw_of, mean_loss
from vlatool.training.control import exchange_labels
from vlatool.training.events import Events
from vlatool.training.expert import Expert, at_most
from vlatool.training.forecast import Forecast
from vlatool.training.frames import concatenate
from vlatool.training.generalization_gap import LOSS_KEY, MAX_ROWS, last_round_losses
from vlatool.training.held_out import HeldOut
from vlatool.training.launcher import RankProcesses
from vlatool.training.loop import Settings, Trainer
from vlatool.training.objective import Objective
from vlatool.training.rounds import Observations, next_round, scene_of, write_labels, write_observations
from vlatool.training.sequences import episode_begins
from vlatool.training.supervision import TEACHER_ALONE, Supervision, parameters
from vlatool.training.teacher import Teacher
from vlatool.training.user_batches import write_user_batches

ROUND = "round-{:03d}.json"
"""File with the actor and the results of a round."""
ALONG_KEY = "along"
"""Key in the first round: loss of a student that keeps values over whole episodes."""
MAX_RECORDED = 100_000
"""Largest number of recorded observations."""


@dataclass(frozen=True)
class Plan:
    """The plan of episodes and batches.

    Args:
        batch: observations in a step.
        episodes: number of episodes that the teacher plays first, over all tasks.
        student_episodes: student episodes that the student plays at each pause.
        pauses: numbers of the steps before which it does.
        noise: what disturbs the actions in them, see ``EpisodesJob``.
        first_seed: seed of the first episode of each task; the others follow.
        patience: pauses in a row without an improvement after which training ends; 0 for never.
        accumulate: parts of a batch, computed one after the other.
        user_rows: rows that are taken from the function of the policy's that yields batches.
    """

    batch: int
    episodes: int
    student_episodes: int
    pauses: Sequence[int]
    noise: float
    first_seed: int
    patience: int = 0
    accumulate: int = 1
    user_rows: int = 0
    supervision: Supervision = TEACHER_ALONE

    def episode_count(self, number: int) -> int:
        """Return the number of episodes of a round."""
        return self.student_episodes if number else self.episodes

    def seed(self, number: int, tasks: int) -> int:
        """Return the seed of the first episode of a round."""
        return self.first_seed + sum(-(-self.episode_count(before) // tasks) for before in range(number))


class Session:
    """Trains a student; its progress is stored in a folder, from which a killed run resumes."""

    def __init__(
        self,
        plan: Plan,
        settings: Settings,
        objective: Objective,
        source: Bundle,
        teacher: Teacher,
        folder: Path,
        context: Context,
        processes: RankProcesses | None = None,
    ) -> None:
        self._plan, self._settings, self._objective = plan, settings, objective
        self._source, self._teacher, self._folder, self._context = source, teacher, folder, context
        self._processes = processes or RankProcesses()
        self._spec = source.manifest.spec
        self._scene = scene_of(source) if plan.episodes or plan.student_episodes else None
        self._plays = self._scene is not None and plan.student_episodes > 0
        self._encode = ObservationEncoder(self._spec, source)
        self._frames = objective.frames(folder)
        self._along = objective.unroll is not None or bool(teacher.program.kept)
        self._held_out = HeldOut(folder, objective.frames) if plan.patience and not self._plays else None
        with self._processes.calling("prepare", {}):
            self._trainer = Trainer(objective.trainable, settings, folder, self._processes.group, objective.constraint)
        self._batches = Batches(objective.loss, self._frames, plan.batch, plan.accumulate, self._processes.group)
        self._expert = Expert(folder, objective.frames)
        self._draw = draw_of(self._batches, plan.supervision.alpha, objective.expert, self._expert.frames)
        self._forecast = Forecast(settings.steps, self._trainer.step)
        self._events = Events(context.events, self._trainer.step)
        self._success = ""

    def run(self) -> dict[str, Any]:
        """Play, label and train until all steps are done; return the record of the training."""
        if self._trainer.step:
            self._context.progress(f"going on from step {self._trainer.step}", None)
        if self._held_out is not None:
            self._held_out.prepare(self._recording(), self._write_held_out, self._write_held_out_batches)
        self._prepare_expert()
        if self._plan.supervision.alpha:
            next_round(self._frames, 0, self._write_first_round)
            self._compare("before")
        pauses = self._plan.pauses if self._plays or self._held_out is not None else ()
        for number, end in enumerate([*pauses, self._settings.steps]):
            if number and self._pause(number):
                break
            self._train(end)
        else:
            if self._plan.patience:
                self._pause(len(pauses) + 1)
        with self._in_all_processes("finish"):
            self._trainer.finish()
        self._compare("after")
        self._events.close()
        return self._summary()

    def observations(self, most: int) -> dict[str, Any]:
        """Return rows of the inputs, spread over all rounds, fewer if they are large: name -> (N, ...)."""
        names = [tensor.name for tensor in self._spec.inputs]
        first = self._frames.rows(np.zeros(1, int))
        held = self._frames.sample_rows(kept_rows(most, sum(first[name].nbytes for name in names)))
        return {name: held[name] for name in (*names, BEGINS) if name in held}

    def _prepare_expert(self) -> None:
        """Write the expert's actions for training and evaluation, where the expert is used."""
        if self._objective.expert is None:
            return
        chosen = self._plan.supervision.label_share, self._settings.seed
        if self._held_out is None:
            self._expert.prepare(self._recording(), self._source, *chosen, self._encode)
            return
        self._expert.prepare(self._held_out.training_part, self._source, *chosen, self._encode)
        self._held_out.expert.prepare(self._held_out.recording, self._source, *chosen, self._encode)

    def _recording(self) -> Recording | None:
        """Return the recorded observations, as whole episodes where student or teacher keep values."""
        return at_most(self._source, MAX_RECORDED, whole=self._along)

    def _compare(self, when: str) -> None:
        """Record the loss of a student that keeps values over whole episodes instead of windows."""
        if self._objective.unroll is None or not self._frames.count:
            return
        about = self._round(0)
        if when == "after" or not self._trainer.step:
            indices = self._frames.sample((0,), MAX_ROWS)
            how = self._objective.validation, self._plan.batch, self._settings.device
            counts = {"episodes": len(indices), "observations": self._frames.row_count(indices)}
            cut = {} if self._objective.unroll.burn_in is None else {"burn_in": self._objective.unroll.burn_in}
            far = {when: mean_loss(self._frames, indices, *how)}
            about[ALONG_KEY] = {**about.get(ALONG_KEY, {}), **counts, **cut, **far}
            self._write_round(0, about)

    def _train(self, end: int) -> None:
        job = {"rounds": self._frames.count, "rows": len(self._frames), "until": end}
        with self._processes.calling("train", job):
            self._trainer.look(partial(self._objective.look, self._frames, self._expert.frames))
            self._trainer.train(end, self._draw, self._report)
            self._trainer.save()

    def _in_all_processes(self, function: str, **job: Any) -> contextlib.AbstractContextManager[None]:
        """Call a function in the other processes during the block, where weights are sharded."""
        return self._processes.calling(function, job) if self._settings.shard else contextlib.nullcontext()

    def _pause(self, number: int) -> bool:
        """Let the student play, and return whether it has stopped improving."""
        if self._plays:
            with self._forecast.pause():
                next_round(self._frames, number, partial(self._write_student_round, number))
                self._measure_gap(number)
            self._note_success(number)
        patience, best = self._plan.patience, self._trainer.best
        if not patience:
            return False
        if len(best.scores) < number:
            score = self._score(number)
            with self._in_all_processes("judge", score=score):
                self._trainer.judge(score)
                self._trainer.save()
        return best.rounds_without_improvement(number) >= patience

    def _measure_gap(self, number: int) -> None:
        """Record the student's loss on the round that it has just played, before it trains on it."""
        about = self._round(number)
        if LOSS_KEY in about or about["step"] != self._trainer.step or self._settings.shard:
            return  # an earlier run did it, or the weights of that step are gone
        how = self._objective.loss, self._plan.batch, self._settings.device
        with self._trainer.averaged_weights():
            about[LOSS_KEY] = last_round_losses(self._frames, number, *how)
        self._events.add(about["step"], {f"loss on {name} rows": loss for name, loss in about[LOSS_KEY].items()})
        self._write_round(number, about)

    def _score(self, number: int) -> float:
        """Return the score of the averaged weights: the success rate, or the negative held-out loss."""
        if self._held_out is None:
            about = self._round(number)
            return float(about["successes"] / about["episodes"])
        with self._in_all_processes("examine"), self._trainer.averaged_weights():
            terms = self._plan.supervision.alpha, self._objective.validation, self._objective.expert
            loss = self._held_out.mixture_loss(*terms, self._plan.batch, self._settings.device)
        self._events.add(self._trainer.step, {"held-out loss": loss})
        self._success = f"held-out loss {loss:.4g}"
        return -loss

    def _summary(self) -> dict[str, Any]:
        best, several, device = self._trainer.best, self._processes.group.size, self._settings.device
        supervision, teacher = self._plan.supervision, self._teacher.program.modules
        judged = "success" if self._held_out is None else "held-out loss"
        scores = best.scores if self._held_out is None else [-score for score in best.scores]
        return {
            "loss": supervision.loss_name(self._objective.name),
            **self._objective.about,
            "precision": device.precision,
            **({"device": device.name} if device.name != "cpu" else {}),
            "threads": require("torch", "build").get_num_threads(),
            **({"processes": several} if several > 1 else {}),
            "losses": self._trainer.losses,
            "rounds": [self._round(number) for number in range(self._frames.count)] or [self._expert.round()],
            "parameters": {"student": parameters(self._objective.modules), "teacher": parameters(teacher)},
            "teacher": supervision.about(self._trainer.gradient_norms, self._expert.counts),
            **({"along": self._round(0)[ALONG_KEY]} if self._objective.unroll and self._frames.count else {}),
            **({"judged": {"by": judged, "scores": scores, "best_step": best.step}} if scores else {}),
        }

    def _round(self, number: int) -> dict[str, Any]:
        about: dict[str, Any] = json.loads((self._folder / ROUND.format(number)).read_text())
        return about

    def _write_round(self, number: int, about: dict[str, Any]) -> None:
        with atomic_file(self._folder / ROUND.format(number)) as draft:
            draft.write_text(json.dumps(about))

    def _note_success(self, number: int) -> None:
        """Remember the student's success rate for the progress."""
        about = self._round(number)
        share = about["successes"] / about["episodes"]
        self._success = f"student {share:.1%} of {about['episodes']}"
        self._events.add(about["step"], {"success": share})

    def _write_held_out(self, observations: Observations, target: Path) -> None:
        self._write(observations, target)
        self._label(target, 0, 1)

    def _write(self, observations: Observations, target: Path) -> None:
        """Write recorded observations, and the beginnings of their episodes where they matter."""
        begins = episode_begins(observations) if self._along and isinstance(observations, Recording) else None
        write_observations(self._encode, observations, target, begins)

    def _write_held_out_batches(self, target: Path) -> bool:
        """Write rows for evaluation from the user's function; return whether there is one."""
        if self._plan.user_rows:
            self._write_user_batches(-(-self._plan.user_rows // 10), self._settings.seed + 1, target)
            self._label(target, 0, 1)
        return bool(self._plan.user_rows)

    def _write_user_batches(self, count: int, seed: int, target: Path) -> None:
        write_user_batches(self._source, count, seed, target, self._context, along=self._along)

    def _write_first_round(self, target: Path) -> None:
        """Write the first round: recordings, batches of the user's function, and the teacher's episodes."""
        recorded = (self._recording() or []) if self._along else recorded_observations(self._source, MAX_RECORDED)
        chosen = self._held_out.training_part if self._held_out is not None else recorded
        self._write(chosen, target / "recorded")
        if self._plan.user_rows:
            self._write_user_batches(self._plan.user_rows, self._settings.seed, target / "yielded")
        self._play(target, 0)

    def _write_student_round(self, number: int, target: Path) -> None:
        """Write a round of episodes of the student with its averaged weights."""
        with self._trainer.averaged_weights():
            self._play(target, number)

    def _play(self, target: Path, number: int) -> None:
        folder, episodes = target / "episodes", self._plan.episode_count(number)
        who = "student" if number else "teacher"
        about: dict[str, Any] = {"step": self._trainer.step, "actor": who}
        if self._scene is not None and episodes:
            self._context.progress(f"the {who} plays {amount(episodes, 'episode')}", None)
            scene, tasks = self._scene
            jobs = [
                replace(job, noise=self._plan.noise, record=str(folder / f"{index:05d}"))
                for index, job in enumerate(jobs_for(scene, tasks, episodes, self._plan.seed(number, len(tasks))))
            ]
            outcomes = run_jobs(self._actor(target / "actor", number), jobs, "", self._context)
            about |= {"episodes": len(outcomes), "successes": sum(outcome.success for outcome in outcomes)}
        about |= {"yielded": self._plan.user_rows} if self._plan.user_rows and not number else {}
        parts = target / "recorded", target / "yielded", *sorted(folder.glob("*"))
        about["observations"] = concatenate(parts, target)
        for part in ("recorded", "yielded", "episodes", "actor"):
            shutil.rmtree(target / part, ignore_errors=True)
        self._write_round(number, about)
        self._label(target, number)

    def _label(self, target: Path, *seed: int) -> None:
        if not self._plan.supervision.alpha:
            return
        names = [tensor.name for tensor in self._spec.inputs]
        outputs = [tensor.name for tensor in self._spec.outputs]
        with self._settings.device.computing():
            seeds = (self._settings.seed, *seed)
            teacher, turns = self._teacher.program, self._objective.turns
            labels = write_labels(target, names, outputs, teacher, seeds, self._context, turns=turns)
        if self._plan.supervision.control == "noise":
            exchange_labels(target, labels, seeds)

    def _actor(self, target: Path, number: int) -> Bundle:
        """Write the policy that plays as a bundle for the processes of the episodes."""
        target.mkdir()
        source, teacher = self._source, self._teacher
        if number:
            with self._in_all_processes("show"), self._trainer.whole():
                edits, modules = read_edits(source), self._objective.modules
                return write_modules(source, target, edits, modules, source.manifest.made_by)
        modules = teacher.program.modules
        program = teacher.program.steps
        return write_modules(
            teacher.bundle, target, teacher.edits, modules, source.manifest.made_by, ModuleChanges(program=program)
        )

    def _report(self, step: int, loss: float) -> None:
        steps, left = self._settings.steps, self._forecast.time_left(step)
        words = [f"step {step} of {steps}", f"loss {loss:.4g}", self._success, left]
        self._context.progress(", ".join(filter(None, words)), step / steps)
        self._events.add(step, {"loss": self._trainer.losses[-1], "learning rate": self._settings.rate(step - 1)})
