"""The functions that the first process of a training calls in the others; see ``launcher``."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, RecipeError, require
from vlatool.files.printable import amount
from vlatool.module.torch_policy import load_modules
from vlatool.stage.build import build_stage
from vlatool.training.batches import Batches, draw_of
from vlatool.training.expert import Expert
from vlatool.training.frames import Frames
from vlatool.training.group import Group, join_group
from vlatool.training.held_out import HeldOut
from vlatool.training.loop import Draw, Trainer
from vlatool.training.objective import Objective
from vlatool.training.stage import TrainingStage
from vlatool.training.torchrun import check_shared, current_launch, open_store
from vlatool.user_code.children import OnProgress

FILE_SYSTEM_TIMEOUT_S = 120.0
"""Seconds until a shared file system must show what the first process wrote."""


@dataclass
class RankState:
    """What a process has loaded and keeps between calls."""

    stage: TrainingStage
    folder: Path
    group: Group
    frames: Frames
    expert: Expert
    objective: Objective
    batches: Draw
    opened: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    trainer: Trainer | None = None

    @property
    def training(self) -> Trainer:
        """Return the trainer, after ``prepare``."""
        if self.trainer is None:
            raise RuntimeError("prepare() comes first")
        return self.trainer


_state: list[RankState] = []


def load(job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Load the student; ``join`` follows."""
    stage, folder = build_stage(job["stage"], job["options"]), Path(job["place"])
    if not isinstance(stage, TrainingStage):
        raise RecipeError(f"The stage {job['stage']} trains nothing.", "name a stage that trains")
    check_shared(job)
    require("torch", "build").set_num_threads(job["threads"])
    source, opened = Bundle.open(Path(job["source"]), verify=False), contextlib.ExitStack()
    group, frames, expert = Group(job["rank"], job["size"]), Frames(folder), Expert(folder)
    teacher, objective = stage.prepare_objective(load_modules(source), source)
    device, launch = stage.settings().device, current_launch()
    if device.name != "cpu":  # else nothing keeps the teacher, unless the objective does
        device.choose(launch.local_rank if launch else job["rank"])
        opened.enter_context(device.holding(objective.trainable, teacher.program.modules))
    batches = Batches(objective.loss, frames, stage.batch, stage.accumulate, group)
    draw = draw_of(batches, stage.supervision().alpha, objective.expert, expert.frames)
    _state[:] = [RankState(stage, folder, group, frames, expert, objective, draw, opened)]


def join(job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Join the group, at the same time as its other processes."""
    state, (store, here) = _state[0], open_store(job)
    state.opened.enter_context(join_group(store, state.group, state.stage.settings().device.name, here=here))


def prepare(_job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Resume the training, and hold a part of the weights where they are sharded."""
    state, objective = _state[0], _state[0].objective
    settings = state.stage.settings()
    state.trainer = Trainer(objective.trainable, settings, state.folder, state.group, objective.constraint)


def train(job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Take steps up to a number, on a number of rounds of rows."""
    state = _state[0]
    for number in range(state.frames.count, job["rounds"]):
        if _wait_for_round(state.frames, number):
            state.frames.read(number)
    state.expert.read()
    if len(state.frames) != job["rows"]:
        raise DataError(
            f"The first process trains on {amount(job['rows'], 'row')}, process {state.group.rank + 1} sees "
            f"{len(state.frames)} of them in {state.folder}.",
            "let all processes see the same folder (VLATOOL_CACHE)",
        )
    state.training.look(partial(state.objective.look, state.frames, state.expert.frames))
    state.training.train(job["until"], state.batches, lambda _step, _loss: None)
    state.training.save()


def _wait_for_round(frames: Frames, number: int) -> bool:
    """Wait until a round that the first process has written is visible; return whether it is."""
    end = time.monotonic() + FILE_SYSTEM_TIMEOUT_S
    while not frames.has(number) and time.monotonic() < end:
        time.sleep(0.1)
    return frames.has(number)


def show(_job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Contribute this process's part of the averaged weights, which are about to act."""
    with _state[0].training.averaged_weights(), _state[0].training.whole():
        pass


def examine(_job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Compute the held-out loss, as the first process does."""
    state, held_out = _state[0], HeldOut(_state[0].folder)
    held_out.read()
    with state.training.averaged_weights():
        terms = state.stage.supervision().alpha, state.objective.validation, state.objective.expert
        held_out.mixture_loss(*terms, state.stage.batch, state.stage.settings().device)


def judge(job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Record the score of the averaged weights."""
    _state[0].training.judge(job["score"])
    _state[0].training.save()


def finish(_job: Mapping[str, Any], _tell: OnProgress) -> None:
    """Contribute this process's part of the result."""
    _state[0].training.finish()
