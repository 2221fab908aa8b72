"""The base of stages that train a policy to imitate a teacher: options, and the course of the training."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.bundle.module_bundle import factory_of
from vlatool.episodes.play import EVALUATION_SEEDS
from vlatool.errors import OutputError, RecipeError, require
from vlatool.files.printable import amount, file_of
from vlatool.files.resumable_work import remove_work, work_directory
from vlatool.module.edits import is_changed
from vlatool.module.source import claimed_source
from vlatool.module.stage import TRAINING, ModuleChanges, ModuleStage
from vlatool.module.zeros import has_zeros, sparse_weights, zero_share
from vlatool.stage.base import Context, Result
from vlatool.stage.run import work_folder
from vlatool.training.constraint import KeptZeros
from vlatool.training.device import Device, DeviceChoice, device_of
from vlatool.training.events import check_events
from vlatool.training.generalization_gap import gap_lines
from vlatool.training.launcher import launch_processes
from vlatool.training.loop import Settings, seconds_of
from vlatool.training.objective import Objective
from vlatool.training.report import along_lines, course, write_training_report
from vlatool.training.rounds import scene_of
from vlatool.training.session import Plan, Session
from vlatool.training.supervision import TEACHER_ALONE, Supervision, teacher_lines
from vlatool.training.teacher import Teacher, check_teacher
from vlatool.training.torchrun import OPTIMIZER, current_launch
from vlatool.training.user_batches import requested_rows

if TYPE_CHECKING:
    from torch import nn

    from vlatool.hardware.profile import Profile

FIRST_SEED = 1_000_000
"""Seed of the first training episode."""
LAST_SHARE = 0.9
"""Share of the steps after which no further episodes are played: little could still be learnt from them."""


class TrainingStage(ModuleStage):
    """Trains on recordings and, where the policy names an environment, on episodes, all labelled by the teacher.

    No expert is needed: first the teacher acts, then repeatedly the student, and the teacher labels every observation
    that they reach (DAgger: Ross et al., arXiv 1011.0686).
    """

    changed_first: ClassVar[bool] = True
    """Whether an unchanged policy has nothing to learn."""
    trains: ClassVar[bool] = True
    imports: ClassVar[tuple[str, ...]] = (OPTIMIZER,)
    policies: ClassVar[tuple[str, ...]] = ("teacher",)
    keeps: ClassVar[int] = 0
    """Number of observations that are stored in the bundle, for the ranges of activations."""
    teacher: Path | None = Field(
        None, description="the teacher: a policy, or its source bundle; the policy before any edit when empty"
    )
    steps: int = Field(1500, ge=1, description="updates of the weights")
    batch: int = Field(256, ge=1, description="observations in an update")
    learning_rate: float = Field(
        5e-4, gt=0, le=1, description="peak learning rate, after warm-up and before cosine decay"
    )
    weight_decay: float = Field(0.01, ge=0, le=10, description="weight decay of AdamW")
    average: float = Field(0.995, ge=0, lt=1, description="decay of the moving average of the weights")
    episodes: int = Field(1200, ge=0, description="episodes that the teacher plays first, over all tasks")
    student_episodes: int = Field(300, ge=0, description="episodes that the student plays each time")
    every: int = Field(250, ge=1, description="steps between the student's episodes")
    noise: float = Field(0.1, ge=0, le=1, description="noise of actions in these episodes, relative to their spread")
    from_batches: int | None = Field(
        None, ge=0, description="rows from the function that policy.yaml names under training; 8192 where no episodes "
        "are played first, else none",
    )  # fmt: skip
    first_seed: int = Field(FIRST_SEED, ge=0, description="seed of the first episode to train on")
    window: int = Field(
        16, ge=1, le=4096, description="consecutive observations that gradients pass through, where the policy keeps "
        "values from step to step; a batch is so many windows as make its observations",
    )  # fmt: skip
    burn_in: int | None = Field(
        None, ge=0, description="observations before each window that bring these values up to date, without "
        "gradients; all since the episode began unless given",
    )  # fmt: skip
    seed: int = Field(0, ge=0, description="random seed of batches and noise")
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto", description="precision of matrix products in training; auto: bfloat16 if the device has it"
    )
    device: DeviceChoice = Field("auto", description="device of the training; auto: a GPU if torch finds one")
    threads: int = Field(0, ge=0, description="threads of torch, over all processes; all cores of this process when 0")
    processes: int = Field(1, ge=1, le=64, description="processes that share each batch and the threads")
    shard: bool = Field(
        False, description="let each of several processes hold a part of weights, gradients and moments alone (FSDP2)"
    )
    accumulate: int = Field(1, ge=1, description="parts of a batch, run one by one: less memory, the same loss")
    patience: int = Field(
        0, ge=0, description="stop after this many rounds without improvement (success, or held-out loss); 0 for never"
    )

    def inputs(self) -> tuple[Path, ...]:
        """The teacher's manifest, or the inputs of its source where it is a policy."""
        if self.teacher is None:
            return ()
        source = claimed_source(self.teacher)
        return (self.teacher / MANIFEST,) if source is None else source.inputs()

    def key(self, source_hash: str) -> str:
        """Return the cache key, including that of a teacher that is a policy (which covers its large weights)."""
        teacher = claimed_source(self.teacher) if self.teacher else None
        return super().key(f"{source_hash} {teacher.key('')}" if teacher else source_hash)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that training and evaluation share no episodes, and that the teacher is another policy."""
        super().check(source, profile)
        for tensor in source.manifest.spec.inputs if source else ():
            if not tensor.shape:
                raise RecipeError(
                    f"{self.name()} learns from batches, and the input '{tensor.name}' has no axes.",
                    "write its shape as [1] in policy.yaml, and take it so in forward()",
                )
        self._check_kept_values(source)
        if self.device == "cuda":
            self._device()
        if self.teacher:
            check_teacher(self.teacher)
        parts = self.processes * self.accumulate
        if self.batch < parts:
            raise RecipeError(
                f"A batch of {self.batch} cannot be split into {parts} parts (processes {self.processes}, accumulate "
                f"{self.accumulate}).",
                "take a larger --batch, or fewer parts",
            )
        self._check_shard(source, parts)
        last = self.first_seed + self.episodes + self._rounds() * self.student_episodes
        if max(self.first_seed + 1, last) > EVALUATION_SEEDS:
            raise RecipeError(
                f"The episodes to train on take the seeds {self.first_seed} to {last}; evaluations begin at "
                f"{EVALUATION_SEEDS}, and would see episodes of the training.",
                "take a smaller --first-seed, or fewer episodes",
            )
        changes = bool(self.chain().before)
        if self.changed_first and not (source is None or self.teacher or changes or is_changed(source)):
            raise RecipeError(
                f"{source.manifest.name} is as its factory makes it: without --teacher it would be its own teacher.",
                "let a part of it be the student (vlatool distill policy --student depth=0.5,width=0.75), prune it "
                "first (vlatool prune structured), or name a --teacher",
            )

    def _check_kept_values(self, source: Bundle | None) -> None:
        """Refuse windows for policies that keep no values, and options that do not work with windows."""
        if source is None:
            return
        kept = [name for step in source.manifest.program for name in step.keep]
        asked = [f"--{name.replace('_', '-')}" for name in ("window", "burn_in") if name in self.options()]
        if asked and not kept:
            raise RecipeError(
                f"{asked[0]} is of policies that keep values from step to step; {source.manifest.name} keeps none.",
                f"leave {asked[0]} out",
            )
        if kept and self.processes > 1:
            raise RecipeError(
                f"{source.manifest.name} keeps '{kept[0]}' from step to step: it is trained on windows of episodes, "
                "which several processes do not share.",
                "leave --processes out; --accumulate takes less memory",
            )
        if kept and self.batch < self.window * self.accumulate:
            raise RecipeError(
                f"A batch of {self.batch} observations holds {amount(self.batch // self.window, 'window')} of "
                f"{self.window}; wanted {self.accumulate}, one for each part, at least.",
                f"take --batch {self.window * self.accumulate} or more, or a shorter --window",
            )

    def _check_shard(self, source: Bundle | None, parts: int) -> None:
        """Refuse sharding with one process, with sparse weights, or with unequal parts of a batch."""
        if self.shard and source is not None and has_zeros(source):
            raise RecipeError(
                f"--shard cuts layers into parts, and {source.manifest.name} has weights that pruning set to zero and "
                "that stay zero.",
                "leave --shard out",
            )
        if self.shard and self.processes == 1:
            raise RecipeError(
                "--shard lets several processes hold a part of the weights each; there is one.",
                "take --processes 2 or more (or torchrun), or leave --shard out",
            )
        if self.shard and self.batch % parts:
            raise RecipeError(
                f"With --shard all processes take equally many rows; a batch of {self.batch} makes no {parts} equal "
                f"parts (processes {self.processes}, accumulate {self.accumulate}).",
                f"take --batch {self.batch - self.batch % parts} or {self.batch + -self.batch % parts}",
            )

    def pauses(self) -> list[int]:
        """Return the steps before which the student plays, or is evaluated on recorded observations."""
        looks = self.student_episodes or self.patience
        return list(range(self.every, round(self.steps * LAST_SHARE), self.every)) if looks else []

    def _rounds(self) -> int:
        """Return how often the student plays, including the evaluation of the last weights."""
        return len(self.pauses()) + bool(self.patience)

    def seeds(self, tasks: int) -> range:
        """Return the seeds of the episodes of each task, at most."""
        return range(self.first_seed, self.plan().seed(1 + self._rounds(), tasks))

    def objective(self, modules: Mapping[str, nn.Module], source: Bundle, teacher: Teacher) -> Objective:
        """Return the objective: the student's loss on a batch with the teacher's labels."""
        raise NotImplementedError(self.name())

    def summarize(self, made: Bundle) -> tuple[str, ...]:
        """Return sentences on the training data and the losses."""
        training = json.loads(made.file(TRAINING).read_bytes())
        seen = sum(round_["observations"] for round_ in training["rounds"])
        played = ", ".join(
            f"{round_['actor']} {round_['successes'] / round_['episodes']:.1%} of {round_['episodes']}"
            for round_ in training["rounds"] if round_.get("episodes")
        )  # fmt: skip
        return (
            *along_lines(training),
            f"{course(training)} on {amount(seen, 'observation')}",
            *([f"episodes that succeeded, with noise: {played}"] if played else []),
            *gap_lines(training["rounds"]),
            *_hint_lines(training.get("hints", {})),
            *teacher_lines(training),
            *_selection_lines(training.get("judged")),
            *(
                [f"weights that pruning set to zero are still zero: {zero_share(made):.1%} of all"]
                if has_zeros(made) and not self.leaves_zeros
                else []
            ),
        )

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Train the modules in place."""
        torch = require("torch", "build")
        before, launch = torch.get_num_threads(), current_launch()
        here = launch.local_size if launch and not self.threads else self.processes
        torch.set_num_threads(max(1, (self.threads or before) // here))
        try:
            with work_directory(work_folder(self, source)) as folder:
                return self._train(modules, source, folder, context)
        except OSError as error:  # about the work folder, not about the bundle
            where = file_of(error) or work_folder(self, source)
            raise OutputError(
                f"The training cannot be kept: {where}: {error.strerror or error}.",
                "make room there, or name another cache (VLATOOL_CACHE); the same command goes on from its last "
                "checkpoint",
            ) from error
        finally:
            torch.set_num_threads(before)

    def _train(self, modules: Mapping[str, nn.Module], source: Bundle, folder: Path, context: Context) -> ModuleChanges:
        plays = self.episodes > 0 and scene_of(source) is not None
        asked = requested_rows(self.from_batches, source, plays) if self.supervision().alpha else 0
        plan = replace(self.plan(), user_rows=asked)
        teacher, objective = self.prepare_objective(modules, source)
        settings, programs = self.settings(), (objective.trainable, teacher.program.modules)
        settings.device.choose(0)
        launch_arguments = self._job(source), self.processes, folder, factory_of(source), settings.device.name
        with settings.device.holding(*programs), launch_processes(*launch_arguments) as processes:
            session = Session(plan, settings, objective, source, teacher, folder, context, processes)
            training = session.run()
            return ModuleChanges(training=training, played=session.observations(self.keeps) if self.keeps else None)

    def prepare_objective(self, modules: Mapping[str, nn.Module], source: Bundle) -> tuple[Teacher, Objective]:
        """Return the teacher for a student's modules, and the objective; each process of a training has its own."""
        teacher = Teacher.of(source, self.teacher, modules)
        objective = self.objective(modules, source, teacher)
        if objective.constraint is None and has_zeros(source):
            objective = replace(objective, constraint=KeptZeros(sparse_weights(modules.values())))
        return teacher, objective

    def settings(self) -> Settings:
        """Return the settings of the training loop."""
        return Settings(
            self.steps, self.learning_rate, self.weight_decay, self.average, self.seed, self._device(), shard=self.shard
        )

    def _device(self) -> Device:
        launch = current_launch()
        return device_of(self.device, self.precision, self.processes, launch.local_size if launch else None)

    def supervision(self) -> Supervision:
        """Return the supervision: by the teacher alone, unless a stage adds an expert."""
        return TEACHER_ALONE

    def plan(self) -> Plan:
        """Return the plan of episodes; none are played where no teacher would label them."""
        supervision = self.supervision()
        episodes = (self.episodes, self.student_episodes) if supervision.alpha else (0, 0)
        played = (self.batch, *episodes, self.pauses(), self.noise, self.first_seed)
        return Plan(*played, self.patience, self.accumulate, supervision=supervision)

    def _job(self, source: Bundle) -> dict[str, Any]:
        """Return the job for another process of the training."""
        threads = require("torch", "build").get_num_threads()
        path = str(source.path.absolute())
        return {"stage": self.name(), "options": self.explicit_options(), "source": path, "threads": threads}

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Train; the checkpoint of a killed run stays until the result is written."""
        if context.events:
            check_events(context.events)
        result = super().run(source, out, context)
        folder = work_folder(self, source)
        write_training_report(result.bundle, seconds_of(folder), context.command)
        remove_work(folder)
        return result


def _hint_lines(hints: Mapping[str, Any]) -> tuple[str, ...]:
    """Return sentences on the blocks that were compared with the teacher's, and the stacks that were not."""
    lines = []
    for name, about in hints.items():
        blocks: dict[str, list[str]] = {}
        for graph, stack, ours, theirs in about["blocks"]:
            blocks.setdefault(f"{graph} {stack}".strip(), []).append(f"{ours}:{theirs}")
        stacks = "; ".join(f"{stack} {' '.join(pairs)}" for stack, pairs in blocks.items())
        lines.append(f"{name} of blocks (student:teacher): {stacks}")
        lines += [f"{name}: {f'{graph} {stack}'.strip()} left out, {why}" for graph, stack, why in
                  about.get("left_out", ())]  # fmt: skip
    return tuple(lines)


def _selection_lines(judged: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Return a sentence on how the best weights were selected, if they were."""
    if judged is None:
        return ()
    scores = ", ".join(f"{score:.4g}" for score in judged["scores"])
    return (f"the weights of step {judged['best_step']} did best, by {judged['by']}: {scores}",)
