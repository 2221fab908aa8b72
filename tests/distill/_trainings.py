"""Small trainings of the tiny policy after it was pruned, in this process, and what stops them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training.loop import Trainer

RECORDED = {"steps": 12, "batch": 6, "episodes": 0, "student_episodes": 0, "every": 3, "learning_rate": 0.003,
            "precision": "float32"}  # fmt: skip


class Killed(BaseException):
    """What stands for a kill in a run in this process: nothing of the run goes on after it."""


@contextmanager
def killed_after(step: int, kill: Callable[[], None]) -> Iterator[None]:
    """Call ``kill`` after a step."""
    take = Trainer._take_step

    def taking(self: Trainer, draw: Any) -> None:
        take(self, draw)
        if self.step == step:
            kill()

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Trainer, "_take_step", taking)
        yield


def raise_killed() -> None:
    raise Killed


def distilled(source: Bundle, out: Path, context: Context | None = None, **options: Any) -> Bundle:
    """Distil for a few steps on recordings."""
    return run_transform(
        build_stage("distill.policy", {**RECORDED, **options}), source, out, context or Context()
    ).bundle


def training_of(made: Bundle) -> dict[str, Any]:
    """What the bundle says of its training."""
    found: dict[str, Any] = json.loads((made.path / "module/training.json").read_text())
    return found


def digest(made: Bundle) -> str:
    """Of the weights."""
    return made.manifest.files["module/main.safetensors"].sha256


def peers() -> list[psutil.Process]:
    """The other processes of the training: children of the servers that this process started."""
    servers = [
        child for child in psutil.Process().children() if "vlatool.user_code._child" in " ".join(child.cmdline())
    ]
    return [peer for server in servers for peer in server.children()]
