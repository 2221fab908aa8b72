"""Another process of a training: what it is called to do, one call after the other; see ``crew``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, require
from vlatool.module.torch_policy import load_modules
from vlatool.stage.base import build_stage
from vlatool.training.batches import Batches, draw_of
from vlatool.training.crew import MEETING
from vlatool.training.expert import Expert
from vlatool.training.frames import Frames
from vlatool.training.group import Group, joined_group
from vlatool.training.loop import Draw, Trainer
from vlatool.training.stage import TrainingStage

Tell = Callable[[str, float | None], None]


@dataclass(frozen=True)
class Peer:
    """What a process has loaded, and keeps between calls."""

    meeting: Path
    group: Group
    frames: Frames
    trainer: Trainer
    batches: Draw
    opened: contextlib.ExitStack
    expert: Expert


_peer: list[Peer] = []


def load(job: Mapping[str, Any], _tell: Tell) -> None:
    """Load the student, and where its training stands; ``join`` follows."""
    stage = build_stage(job["stage"], job["options"])
    if not isinstance(stage, TrainingStage):
        raise RecipeError(f"The stage {job['stage']} trains nothing.")
    require("torch", "build").set_num_threads(job["threads"])
    source, place = Bundle.open(Path(job["source"]), verify=False), Path(job["place"])
    group, frames = Group(job["rank"], job["size"]), Frames(place)
    _, lesson = stage.prepared(load_modules(source), source)
    trainer = Trainer(lesson.trained, stage.settings(), place, group, lesson.constraint)
    batches = Batches(lesson.loss, frames, stage.batch, stage.accumulate, group)
    expert = Expert(place)
    draw = draw_of(batches, stage.supervision().alpha, lesson.expert, expert.frames)
    _peer[:] = [Peer(place / MEETING, group, frames, trainer, draw, contextlib.ExitStack(), expert)]


def join(_job: Mapping[str, Any], _tell: Tell) -> None:
    """Become one of the group, whose other processes do so at the same time."""
    peer = _peer[0]
    peer.opened.enter_context(joined_group(peer.meeting, peer.group))


def train(job: Mapping[str, Any], _tell: Tell) -> None:
    """Take the steps until one of them, on so many rounds of rows."""
    peer = _peer[0]
    for number in range(peer.frames.count, job["rounds"]):
        peer.frames.read(number)
    peer.expert.read()
    peer.trainer.train(job["until"], peer.batches, lambda _step, _loss: None)
