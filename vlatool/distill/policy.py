"""Distillation: a policy is trained on what a teacher would do, without an expert."""

from __future__ import annotations

import inspect
import json
import shutil
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.episodes.play import run_jobs
from vlatool.errors import RecipeError, nearest, require
from vlatool.files.work import forget, work_directory
from vlatool.machine import host
from vlatool.module.batched import BatchedProgram
from vlatool.module.edits import Edit, read_edits
from vlatool.module.stage import TRAINING, Changed, ModuleStage, write_changed
from vlatool.module.torch_policy import load_modules, unedited_modules
from vlatool.runtime.observation import ObservationEncoder
from vlatool.stage.base import Context
from vlatool.stage.cache import STREAMS
from vlatool.training.frames import Frames, joined
from vlatool.training.loop import Settings, Trainer, has_bfloat16
from vlatool.training.rounds import LABEL, NOISE, label, next_round, scene_of, tensors, write_recorded

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vlatool.hardware.profile import Profile

FIRST_SEED = 1_000_000
"""Of the first episode to train on; evaluations begin at 5,000,000."""
LAST_SHARE = 0.9
"""Share of the steps after which no further episodes are played: what they bring could hardly be learnt any more."""
ROUND = "round-{:03d}.json"
"""File that says who acted in a round, and how well."""
SEEDS = 100_000
"""Seeds between rounds."""
RECORDED = 100_000
"""Recorded observations at most."""


class PolicyDistillation(ModuleStage):
    """Train a policy to do what a teacher does, on recordings and, where it names an environment, on episodes.

    The teacher is the policy as it was before any edit, so that this recovers what pruning lost; or another bundle. No
    expert is needed: first the teacher acts, then again and again the student, and the teacher says what it would have
    done wherever they came to (DAgger: Ross et al., arXiv 1011.0686).
    """

    teacher: Path | None = Field(
        None, description="source bundle of the teacher; the policy before any edit when empty"
    )
    loss: str = Field("auto", description="kl (discrete actions), l1, l2 or huber; kl or l1 when auto")
    temperature: float = Field(2.0, gt=0, description="of kl")
    delta: float = Field(0.1, gt=0, description="of huber")
    steps: int = Field(1500, ge=1, description="updates of the weights")
    batch: int = Field(256, ge=1, description="observations in an update")
    learning_rate: float = Field(5e-4, gt=0, description="its highest value; it warms up, and falls as a cosine")
    weight_decay: float = Field(0.01, ge=0, description="of AdamW")
    average: float = Field(0.995, ge=0, lt=1, description="decay of the moving average of the weights")
    episodes: int = Field(1200, ge=0, description="episodes that the teacher plays first, over all tasks")
    student_episodes: int = Field(300, ge=0, description="episodes that the student plays each time")
    every: int = Field(250, ge=1, description="steps between the student's episodes")
    noise: float = Field(0.1, ge=0, le=1, description="disturbs the actions in these episodes: share of their spread")
    first_seed: int = Field(FIRST_SEED, ge=0, description="seed of the first episode to train on")
    seed: int = Field(0, ge=0, description="of batches and noise")
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto", description="of matrix products in training; bfloat16 where the processor has it"
    )
    threads: int = Field(0, ge=0, description="of torch; all cores of this process when 0")

    def inputs(self) -> tuple[Path, ...]:
        """The teacher's manifest."""
        return (self.teacher / "manifest.json",) if self.teacher else ()

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The loss is known, and fits the action."""
        super().check(source, profile)
        known = registry.names("losses")
        if self.loss != "auto" and self.loss not in known:
            raise RecipeError(f"Unknown loss '{self.loss}'; {nearest(self.loss, ['auto', *known])}.")
        if source is not None and self.loss == "kl" and source.manifest.spec.action.kind != "discrete":
            raise RecipeError("The loss kl compares discrete actions; the policy's are continuous.", "try --loss l1")

    def loss_for(self, source: Bundle) -> str:
        """Return the name of the loss; where it is left to vlatool, the one that fits the action."""
        automatic = "kl" if source.manifest.spec.action.kind == "discrete" else "l1"
        return automatic if self.loss == "auto" else self.loss

    def lines(self, made: Bundle) -> tuple[str, ...]:
        """Say what the student learnt from, and how far it came."""
        training = json.loads(made.file(TRAINING).read_bytes())
        losses, last = training["losses"], max(1, len(training["losses"]) // 20)
        seen = sum(round_["observations"] for round_ in training["rounds"])
        first, end = np.mean(losses[:last]), np.mean(losses[-last:])
        played = ", ".join(
            f"{round_['actor']} {round_['successes'] / round_['episodes']:.1%} of {round_['episodes']}"
            for round_ in training["rounds"] if round_.get("episodes")
        )  # fmt: skip
        return (
            f"{training['loss']} {first:.4g} -> {end:.4g} in {len(losses)} steps on {seen} observations",
            *([f"episodes that succeeded, with noise: {played}"] if played else []),
            *super().lines(made),
        )

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> Changed:
        """Train the modules in place."""
        torch = require("torch", "build")
        before = torch.get_num_threads()
        torch.set_num_threads(self.threads or before)
        place = host.cache_directory() / STREAMS / f"{self.name()}-{self.key(source.hash)}"
        try:
            with work_directory(place):
                training = _Distillation(self, modules, source, place, context).run()
        finally:
            torch.set_num_threads(before)
        forget(place)
        return Changed(training=training)


class _Distillation:
    """One run: what is kept between its parts."""

    def __init__(
        self, stage: PolicyDistillation, modules: Mapping[str, nn.Module], source: Bundle, place: Path, context: Context
    ) -> None:
        self._stage, self._source, self._place, self._context = stage, source, place, context
        self._spec = source.manifest.spec
        self._modules = modules
        self._taught_by, self._teacher_edits, teacher = _teacher_of(stage, source)
        _check_fits(self._taught_by, source)
        self._teacher = BatchedProgram(self._taught_by.manifest.program, teacher)
        self._student = BatchedProgram(source.manifest.program, modules)
        self._scene = scene_of(source) if stage.episodes or stage.student_episodes else None
        self._loss_name = stage.loss_for(source)
        self._loss = _loss_of(stage, self._loss_name)
        self._frames = Frames(place)
        self._bfloat16 = stage.precision == "bfloat16" or (stage.precision == "auto" and has_bfloat16(host.isa()))
        settings = Settings(
            stage.steps, stage.learning_rate, stage.weight_decay, stage.average, stage.seed, self._bfloat16
        )
        self._trainer = Trainer(modules, settings, place)

    def run(self) -> dict[str, Any]:
        """Play, label and train until all steps are done; return what there is to know of it."""
        next_round(self._frames, 0, self._first)
        ends = [*self._pauses(), self._stage.steps]
        for number, end in enumerate(ends):
            if number:
                next_round(self._frames, number, partial(self._students, number))
            self._trainer.train(end, self._draw, self._tell)
            self._trainer.save()
        self._trainer.finish()
        rounds = [json.loads((self._place / ROUND.format(number)).read_text()) for number in range(len(ends))]
        precision = "bfloat16" if self._bfloat16 else "float32"
        threads = require("torch", "build").get_num_threads()
        return {
            "loss": self._loss_name,
            "precision": precision,
            "threads": threads,
            "losses": self._trainer.losses,
            "rounds": rounds,
        }

    def _pauses(self) -> list[int]:
        """Return before which steps the student plays."""
        if self._scene is None or not self._stage.student_episodes:
            return []
        return list(range(self._stage.every, round(self._stage.steps * LAST_SHARE), self._stage.every))

    def _first(self, target: Path) -> None:
        """Write the first round: recordings, and the teacher's episodes."""
        encode = ObservationEncoder(self._spec, self._source)
        write_recorded(map(encode, recorded_observations(self._source, RECORDED)), target / "recorded")
        self._play(target, 0, self._stage.episodes)

    def _students(self, number: int, target: Path) -> None:
        """Write a round of the student's episodes; its averaged weights act."""
        self._trainer.swap()
        try:
            self._play(target, number, self._stage.student_episodes)
        finally:
            self._trainer.swap()

    def _play(self, target: Path, number: int, episodes: int) -> None:
        stage, seed = self._stage, self._stage.first_seed + number * SEEDS
        folder = target / "episodes"
        about: dict[str, Any] = {"step": self._trainer.step, "actor": "student" if number else "teacher"}
        if self._scene is not None and episodes:
            who = "student" if number else "teacher"
            self._context.tell(f"the {who} plays {episodes} episodes", None)
            jobs = self._scene.jobs(episodes, seed, stage.noise, folder)
            outcomes = run_jobs(self._actor(target / "actor", number), jobs, "", self._context)
            about |= {"episodes": len(outcomes), "successes": sum(outcome.success for outcome in outcomes)}
        about["observations"] = joined((target / "recorded", *sorted(folder.glob("*"))), target)
        for part in ("recorded", "episodes", "actor"):
            shutil.rmtree(target / part, ignore_errors=True)
        names = [tensor.name for tensor in self._spec.inputs]
        outputs = [tensor.name for tensor in self._spec.outputs]
        (self._place / ROUND.format(number)).write_text(json.dumps(about))
        label(target, names, outputs, self._teacher, (stage.seed, number), self._context)

    def _actor(self, place: Path, number: int) -> Bundle:
        """Write who plays as a bundle, which the processes that play open."""
        place.mkdir()
        source = self._source
        if number:
            return write_changed(source, place, read_edits(source), self._modules, source.manifest.made_by)
        return write_changed(
            self._taught_by, place, self._teacher_edits, self._teacher.modules, source.manifest.made_by
        )

    def _draw(self, random: np.random.Generator) -> Tensor:
        """Return the loss of a batch."""
        rows = self._frames.batch(random.integers(len(self._frames), size=self._stage.batch))
        values = self._student.run(tensors(rows), tensors(rows, NOISE))
        name = self._spec.action.name
        loss: Tensor = self._loss(values[name].float(), tensors(rows, LABEL)[name])
        return loss

    def _tell(self, step: int, loss: float) -> None:
        self._context.tell(f"step {step} of {self._stage.steps}, loss {loss:.4g}", step / self._stage.steps)


def _teacher_of(stage: PolicyDistillation, source: Bundle) -> tuple[Bundle, tuple[Edit, ...], dict[str, nn.Module]]:
    """Return the teacher's bundle, its edits, and its modules."""
    if stage.teacher:
        bundle = Bundle.open(stage.teacher)
        if bundle.manifest.graphs or "factory" not in bundle.manifest.source:
            raise RecipeError(
                f"{stage.teacher} has no torch modules that could teach: it is exported, or an ONNX file.",
                "name the bundle that it was exported from",
            )
        return bundle, read_edits(bundle), load_modules(bundle)
    return source, (), unedited_modules(source)


def _loss_of(stage: PolicyDistillation, name: str) -> Any:
    """Return the loss with the options that it takes."""
    kind = registry.load("losses", name)
    takes = inspect.signature(kind).parameters
    return kind(**{option: getattr(stage, option) for option in ("temperature", "delta") if option in takes})


def _check_fits(teacher: Bundle, student: Bundle) -> None:
    """Refuse a teacher that sees or does something else.

    Raises:
        RecipeError: saying what differs.
    """
    for ours, theirs, what in (
        (student.manifest.spec.inputs, teacher.manifest.spec.inputs, "is given"),
        (student.manifest.spec.outputs, teacher.manifest.spec.outputs, "gives"),
    ):
        wanted = {tensor.name: (tensor.kind, tensor.shape, tensor.dtype, tensor.labels) for tensor in ours}
        other = {tensor.name: (tensor.kind, tensor.shape, tensor.dtype, tensor.labels) for tensor in theirs}
        for name in sorted({*wanted, *other}):
            if wanted.get(name) != other.get(name):
                raise RecipeError(
                    f"The teacher {what} '{name}' as {_shown(other.get(name))}, the student as "
                    f"{_shown(wanted.get(name))}; they must agree.",
                    "take a teacher with the same inputs and outputs",
                )


def _shown(tensor: Any) -> str:
    return "nothing" if tensor is None else f"{tensor[0]} {list(tensor[1])} {tensor[2]}"
