"""The training loop: AdamW, warm-up and cosine, averaged weights; a killed run resumes bit for bit.

What a step does depends on the seed, its number and the weights alone: a run that continues from a checkpoint ends with
the same weights, bit for bit, on the same processor with the same number of threads and processes.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.errors import DataError, require
from vlatool.files.printable import message_of
from vlatool.files.user_files import atomic_file
from vlatool.module.batched_program import no_gradient_error
from vlatool.module.edits import save_tensors, stream_tensors
from vlatool.training.best import Best
from vlatool.training.constraint import Constraint
from vlatool.training.device import CPU, Device
from vlatool.training.group import Group
from vlatool.training.mixture import Draw as Draw
from vlatool.training.mixture import Mixture
from vlatool.training.mixture import Part as Part
from vlatool.training.shards import shards_of

if TYPE_CHECKING:
    from torch import Tensor, nn

CHECKPOINT = "checkpoint.safetensors"
CLIP = 1.0
"""Largest norm of the gradient."""
GRADIENT_SAMPLES = (0.05, 0.5, 0.95)
"""Shares of the steps at which the gradient of each term of a loss with several terms is measured."""
WARMUP = 0.05
"""Share of the steps in which the learning rate rises."""


@dataclass(frozen=True)
class Settings:
    """Settings of the training loop.

    Args:
        weight_decay: weight decay of weights with two axes or more, decoupled (AdamW).
        average: decay of the exponential moving average of the weights, which is the result.
        shard: whether each process holds a part of the weights alone.
    """

    steps: int
    learning_rate: float = 5e-4
    weight_decay: float = 0.01
    average: float = 0.995
    seed: int = 0
    device: Device = CPU
    checkpoint_s: float = 30.0
    shard: bool = False

    def rate(self, step: int) -> float:
        """Return the learning rate of a step: linear warm-up, then a cosine to zero."""
        warmup = max(1, round(self.steps * WARMUP))
        if step < warmup:
            return self.learning_rate * (step + 1) / warmup
        share = (step - warmup) / max(1, self.steps - warmup)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


class Trainer:
    """Trains the parameters of modules in place.

    Modules stay in evaluation mode: normalisations keep their statistics, and nothing is dropped, so that what is
    trained is what runs on the robot.

    Args:
        group: the processes that train together; the first one writes checkpoints.
    """

    def __init__(
        self,
        modules: Mapping[str, nn.Module],
        settings: Settings,
        folder: Path,
        group: Group | None = None,
        constraint: Constraint | None = None,
    ) -> None:
        torch = require("torch", "build")
        self._settings, self._group, self._constraint = settings, group or Group(), constraint or Constraint()
        self._file = folder / CHECKPOINT
        with settings.device.computing():
            self._shards = shards_of(modules, self._group, cut=settings.shard)
        self._weights = self._shards.held
        decayed = [value for value in self._weights.values() if value.dim() > 1]
        plain = [value for value in self._weights.values() if value.dim() <= 1]
        groups = [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": plain, "weight_decay": 0.0}]
        self._optimizer = torch.optim.AdamW([group for group in groups if group["params"]], lr=settings.learning_rate)
        self._average = {name: value.detach().clone() for name, value in self._weights.items()}
        self.best = Best()
        self.step = 0
        self.losses: list[float] = []
        self.gradient_norms: list[list[float]] = []
        """Number of a step, and the norm of the gradient of each term of its loss."""
        self._start = time.monotonic()
        self._resume()

    @property
    def seconds(self) -> float:
        """Wall-clock time of the training, over all runs up to their last checkpoints."""
        return time.monotonic() - self._start

    def train(self, until: int, draw: Draw, progress: Callable[[int, float], None]) -> None:
        """Take steps up to a number.

        Args:
            until: number of steps after which to stop.
            draw: function that returns the loss of a randomly drawn batch.
            progress: function called with the number of steps and the mean of the last losses.

        Raises:
            DataError: when the loss is not finite.
            SourceError: when it does not depend on the weights.
        """
        saved = time.monotonic()
        while self.step < until:
            with self._settings.device.computing(), self._shards.computing():
                self._take_step(draw)
            progress(self.step, float(np.mean(self.losses[-20:])))
            if self._checkpoint_due(saved):
                self.save()
                saved = time.monotonic()

    def _checkpoint_due(self, saved: float) -> bool:
        """Return whether a checkpoint is due, which all processes write together where weights are sharded."""
        due = self._group.rank == 0 and time.monotonic() - saved > self._settings.checkpoint_s
        return self._group.total(float(due)) > 0 if self._shards.several else due

    def _take_step(self, draw: Draw) -> None:
        self._optimizer.zero_grad()
        random = np.random.default_rng((self._settings.seed, self.step))
        if isinstance(draw, Mixture) and self.step in {int(share * self._settings.steps) for share in GRADIENT_SAMPLES}:
            loss = self._measure_gradients(draw, random)
        else:
            loss = self._shards.sum_gradients(self._own_loss(draw(random)), self._group)
        if not math.isfinite(loss):
            raise DataError(
                f"The loss is {loss} in step {self.step + 1} of {self._settings.steps}.",
                "try a lower --learning-rate, and look for values that are not finite in the recordings",
            )
        for group in self._optimizer.param_groups:
            group["lr"] = self._settings.rate(self.step)
        norm = self._shards.norm(self._group)
        require("torch", "build").nn.utils.clip_grads_with_norm_(list(self._weights.values()), CLIP, norm)
        with self._constraint.step(self.step + 1):
            self._optimizer.step()
        self._update_average()
        self.step += 1
        self.losses.append(loss)

    def _measure_gradients(self, mixture: Mixture, random: np.random.Generator) -> float:
        """Add the gradients of all terms, and record the norm of each; return the loss."""
        weights, total, norms = list(self._weights.values()), 0.0, []
        sums: list[Tensor | None] = [None] * len(weights)
        for term in mixture.terms:
            self._optimizer.zero_grad()
            total += self._shards.sum_gradients(self._own_loss(term(random)), self._group)
            norms.append(float(self._shards.norm(self._group)))
            sums = [value.grad if before is None else before if value.grad is None else before + value.grad
                    for before, value in zip(sums, weights, strict=True)]  # fmt: skip
        for value, gradient in zip(weights, sums, strict=True):
            value.grad = gradient
        self.gradient_norms.append([self.step + 1, *norms])
        return total

    def _own_loss(self, parts: Iterable[Part]) -> float:
        """Add the gradients of this process's parts of the batch; return their share of its loss."""
        total = 0.0
        for share, compute in parts:
            with self._settings.device.casting():
                loss = compute()
            if not loss.requires_grad:
                raise no_gradient_error("let make() return the module that was trained, as it was trained")
            (loss * share).backward()  # type: ignore[no-untyped-call]
            total += share * float(loss.detach())
        return total

    def judge(self, score: float) -> None:
        """Record the score of the averaged weights, and the weights if it is the best."""
        self.best.look(score, self.step, self._average)

    def _update_average(self) -> None:
        """Update the moving average of the weights, with a smaller decay in the first steps."""
        decay = min(self._settings.average, (1 + self.step) / (10 + self.step))
        with require("torch", "build").no_grad():
            for name, value in self._weights.items():
                self._average[name].lerp_(value, 1 - decay)
                self._constraint.average(value, self._average[name])

    def swap(self) -> None:
        """Exchange the weights and their average."""
        with require("torch", "build").no_grad():
            for name, value in self._weights.items():
                kept = value.detach().clone()
                value.copy_(self._average[name])
                self._average[name].copy_(kept)

    @contextlib.contextmanager
    def averaged_weights(self) -> Iterator[None]:
        """Use the averaged weights as weights within the block."""
        self.swap()
        try:
            with self._shards.computing():
                yield
        finally:
            self.swap()

    def whole(self) -> contextlib.AbstractContextManager[None]:
        """Return a context in which the modules of the first process have all weights; all processes must enter it."""
        return self._shards.in_modules(keep=self._group.rank == 0)

    def look(self, look: Callable[[], None]) -> None:
        """Let programs probe together whether their modules take batches, where weights are sharded."""
        if self._shards.several:
            with self._settings.device.computing(), self._shards.computing(), self._shards.probing_batches():
                look()

    def finish(self) -> None:
        """Replace the weights by their average, the best one where that is known, and stop tracking gradients.

        The modules of the first process have all weights from then on; all processes must call this.
        """
        self._average.update(self.best.weights)
        self.swap()
        for value in self._weights.values():
            value.requires_grad_(False)
        if self._shards.several:  # no step follows, and no checkpoint
            for kept in (self._optimizer.state, self._average, self.best.weights):
                kept.clear()
        self._shards.gather(keep=self._group.rank == 0)

    def save(self) -> None:
        """Write a checkpoint atomically, in the first process with the parts of all; raises OSError when that fails."""
        shards, tensors = self._shards, sorted(self._checkpoint_tensors(), key=lambda each: -each[2].dtype.itemsize)
        if self._group.rank:
            for _, name, held in tensors if shards.several else ():
                shards.whole(name, held)
            return
        about = {"step": str(self.step), "losses": json.dumps(self.losses), "best": self.best.text(),
                 "looks": json.dumps(self.gradient_norms), "seconds": f"{self.seconds:.3f}"}  # fmt: skip
        with atomic_file(self._file) as draft:
            if not shards.several:
                save_tensors(
                    draft, {f"{kind}.{name}": held.detach().contiguous() for kind, name, held in tensors}, about
                )
                return
            forms = {f"{kind}.{name}": (held.dtype, shards.size(name, held)) for kind, name, held in tensors}
            stream_tensors(draft, forms, (shards.whole(name, held) for _, name, held in tensors), about)

    def _checkpoint_tensors(self) -> Iterator[tuple[str, str, Tensor]]:
        """Yield the content of a checkpoint: kind, name of the weight, and tensor, or this process's part of it."""
        for name, value in self._weights.items():
            yield "weight", name, value
            yield "average", name, self._average[name]
            for kind, held in self._optimizer.state[value].items():
                yield kind, name, held
        for name, held in self.best.weights.items():
            yield "best", name, held

    def _resume(self) -> None:
        """Resume from the checkpoint, if there is one."""
        if not self._file.is_file():
            return
        safetensors, torch = require("safetensors", "build"), require("torch", "build")
        try:
            with safetensors.safe_open(str(self._file), "pt") as opened, torch.no_grad():
                self._load(opened)
        except (safetensors.SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise DataError(
                f"The checkpoint {self._file} is damaged: {message_of(error)}.",
                f"remove {self._file.parent}: the training then begins anew",
            ) from error

    def _load(self, opened: Any) -> None:
        about, names = opened.metadata(), set(opened.keys())
        self.step, self.losses = int(about["step"]), json.loads(about["losses"])
        self.gradient_norms = json.loads(about["looks"])
        self._start -= float(about["seconds"])

        def part(kind: str, name: str) -> Tensor:
            return self._shards.part(name, opened.get_tensor(f"{kind}.{name}"))

        best = {name: part("best", name).clone() for name in self._weights if f"best.{name}" in names}
        self.best = Best.of(about["best"], best)
        for name, value in self._weights.items():
            value.copy_(part("weight", name))
            self._average[name].copy_(part("average", name))
            state: dict[str, Any] = {
                kind: part(kind, name).to("cpu" if kind == "step" else value.device, copy=True)
                for kind in ("step", "exp_avg", "exp_avg_sq")
                if f"{kind}.{name}" in names
            }
            if state:
                self._optimizer.state[value] = state


def seconds_of(folder: Path) -> float:
    """Return the wall-clock time of a training from its last checkpoint."""
    with require("safetensors", "build").safe_open(str(folder / CHECKPOINT), "pt") as opened:
        return float(opened.metadata()["seconds"])
