"""Small policies saved by torch itself, and how they are trusted in a test."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec
from vlatool.data import random_observations
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources import source_stage
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.user_code import trust


class Branching(nn.Module):
    """Two inputs, and a branch that depends on the values of one."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(16, 32), nn.Linear(32, 6)

    def forward(self, state: Tensor, goal: Tensor) -> Tensor:
        hidden = torch.relu(self.first(state))
        if bool(goal.sum() > 0):
            hidden = hidden * 2
        return self.second(hidden)


class Named(nn.Module):
    """Takes a dict of tensors and returns one."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(8, 3)

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        action = self.net(torch.cat([batch["observation.state"], batch["goal"]], 1))
        return {"action": action, "value": action.abs().sum(1, keepdim=True)}


class Camera(nn.Module):
    """A picture and a memory; returns an action and the memory."""

    def __init__(self) -> None:
        super().__init__()
        self.conv, self.cell, self.head = nn.Conv2d(3, 4, 3), nn.GRU(4, 5, batch_first=True), nn.Linear(5, 2)

    def forward(self, image: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        seen = torch.relu(self.conv(image)).mean((2, 3))[:, None]
        out, memory = self.cell(seen, memory)
        return self.head(out[:, 0]), memory


class Tokens(nn.Module):
    """Ids of a text."""

    def __init__(self) -> None:
        super().__init__()
        self.words, self.head = nn.Embedding(50, 8), nn.Linear(8, 4)

    def forward(self, ids: Tensor) -> Tensor:
        return self.head(self.words(ids).mean(1))


def saved(module: nn.Module, path: Path, *example: Any) -> Path:
    """Save a module: a program of torch.export, traced where there is an example, else scripted; and trust it."""
    module = module.eval()
    random = torch.Generator().manual_seed(0)
    for weight in module.parameters():
        weight.data.normal_(0, 0.3, generator=random)
    with quiet():
        if path.suffix == ".pt2":
            torch.export.save(torch.export.export(module, example), path)
        else:
            torch.jit.save(torch.jit.trace(module, example) if example else torch.jit.script(module), str(path))
    trust.trust(path)
    return path


def opened(path: Path) -> Any:
    """Open a file in torch."""
    with quiet():
        return torch.export.load(path).module() if path.suffix == ".pt2" else torch.jit.load(str(path))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Ignore what torch says of its older parts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def bundle_of(path: Path, out: Path, **options: Any) -> Bundle:
    """Run the source of a path as a command does."""
    stage = source_stage(str(path))
    stage = stage.model_copy(update=options)
    return run_transform(stage, None, out, Context()).bundle


def assert_same(bundle: Bundle, expected: Any, count: int = 50, allowed: float = 1e-4) -> None:
    """Compare a bundle without torch with what a module answers for random observations.

    Args:
        expected: takes the observation as tensors with a batch, returns output -> tensor.
    """
    policy = load(bundle.path, threads=1)
    spec: PolicySpec = bundle.manifest.spec
    for observation in random_observations(spec, count, seed=5):
        with torch.no_grad():
            wanted = expected({name: torch.from_numpy(np.asarray(value)[None]) for name, value in observation.items()})
        got = policy.infer(observation).outputs
        for name, value in wanted.items():
            assert relative_error(got[name], value.numpy()) <= allowed, name


@pytest.fixture
def trusting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An own file of what is trusted."""
    monkeypatch.setenv(trust.TRUST_VARIABLE, str(tmp_path / "trusted.json"))
    return tmp_path
