"""One training: rounds of episodes and labels, and the steps between them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.episodes.play import jobs_for, run_jobs
from vlatool.errors import require
from vlatool.module.edits import read_edits
from vlatool.module.stage import write_changed
from vlatool.runtime.observation import ObservationEncoder
from vlatool.stage.base import Context
from vlatool.training.frames import Frames, joined
from vlatool.training.loop import Settings, Trainer
from vlatool.training.rounds import label, next_round, scene_of, write_recorded
from vlatool.training.teacher import Teacher

if TYPE_CHECKING:
    from torch import Tensor, nn

ROUND = "round-{:03d}.json"
"""File that says who acted in a round, and how well."""
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
    """

    batch: int
    episodes: int
    student_episodes: int
    pauses: Sequence[int]
    noise: float
    first_seed: int

    def asked(self, number: int) -> int:
        """Return how many episodes a round has."""
        return self.student_episodes if number else self.episodes

    def seed(self, number: int, tasks: int) -> int:
        """Return the seed of the first episode of a round."""
        return self.first_seed + sum(-(-self.asked(before) // tasks) for before in range(number))


@dataclass(frozen=True)
class Lesson:
    """What a student is trained to make small.

    Args:
        name: Of the loss.
        modules: The student's, which are trained in place.
        loss: Rows of a batch, name -> (B, ...), as ``label`` wrote them -> their loss.
    """

    name: str
    modules: Mapping[str, nn.Module]
    loss: Callable[[Mapping[str, Any]], Tensor]


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
    ) -> None:
        self._plan, self._settings, self._lesson = plan, settings, lesson
        self._source, self._teacher, self._place, self._context = source, teacher, place, context
        self._spec = source.manifest.spec
        self._scene = scene_of(source) if plan.episodes or plan.student_episodes else None
        self._frames = Frames(place)
        self._trainer = Trainer(lesson.modules, settings, place)

    def run(self) -> dict[str, Any]:
        """Play, label and train until all steps are done; return what there is to know of it."""
        next_round(self._frames, 0, self._first)
        ends = [*(self._plan.pauses if self._scene else ()), self._settings.steps]
        for number, end in enumerate(ends):
            if number:
                next_round(self._frames, number, partial(self._students, number))
            self._trainer.train(end, self._draw, self._tell)
            self._trainer.save()
        self._trainer.finish()
        return {
            "loss": self._lesson.name,
            "precision": "bfloat16" if self._settings.bfloat16 else "float32",
            "threads": require("torch", "build").get_num_threads(),
            "losses": self._trainer.losses,
            "rounds": [json.loads((self._place / ROUND.format(number)).read_text()) for number in range(len(ends))],
        }

    def _first(self, target: Path) -> None:
        """Write the first round: recordings, and the teacher's episodes."""
        encode = ObservationEncoder(self._spec, self._source)
        write_recorded(encode, recorded_observations(self._source, RECORDED), target / "recorded")
        self._play(target, 0)

    def _students(self, number: int, target: Path) -> None:
        """Write a round of the student's episodes; its averaged weights act."""
        self._trainer.swap()
        try:
            self._play(target, number)
        finally:
            self._trainer.swap()

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
        about["observations"] = joined((target / "recorded", *sorted(folder.glob("*"))), target)
        for part in ("recorded", "episodes", "actor"):
            shutil.rmtree(target / part, ignore_errors=True)
        names = [tensor.name for tensor in self._spec.inputs]
        outputs = [tensor.name for tensor in self._spec.outputs]
        (self._place / ROUND.format(number)).write_text(json.dumps(about))
        label(target, names, outputs, self._teacher.program, (self._settings.seed, number), self._context)

    def _actor(self, place: Path, number: int) -> Bundle:
        """Write who plays as a bundle, which the processes that play open."""
        place.mkdir()
        source, teacher = self._source, self._teacher
        if number:
            return write_changed(source, place, read_edits(source), self._lesson.modules, source.manifest.made_by)
        modules = teacher.program.modules
        program = teacher.program.steps
        return write_changed(teacher.bundle, place, teacher.edits, modules, source.manifest.made_by, program=program)

    def _draw(self, random: np.random.Generator) -> Tensor:
        """Return the loss of a batch."""
        return self._lesson.loss(self._frames.batch(random.integers(len(self._frames), size=self._plan.batch)))

    def _tell(self, step: int, loss: float) -> None:
        self._context.tell(f"step {step} of {self._settings.steps}, loss {loss:.4g}", step / self._settings.steps)
