"""Train the vln-babyai policy from scratch: behaviour cloning of minigrid's bot, then DAgger.

Writes weights.safetensors, training_curve.csv, calibration.npz and evaluation.npz.
"""

from __future__ import annotations

import argparse
import copy
import csv
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from demonstrations import Batch, Demonstrations, collect
from environment import CODES, VIEW, tile_images
from numpy.typing import NDArray
from policy import CHANNELS, FRAMES, Policy, make
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rollout import LADDER, Episode, play, word_ids
from safetensors.torch import save_file
from samples import write_samples
from torch import Tensor

BATCH = 256
ROUND_STEPS = 200  # optimizer steps between two DAgger rounds
EXPERT_EPISODES = 5_000
ROUND_EPISODES = 800
PEAK_LEARNING_RATE = 1e-3
WARM_UP_STEPS = 200
AVERAGE_DECAY = 0.998
VALIDATION_SEED = 1_500_000  # training seeds count up from 0; the success table uses 1,000,000 and above
VALIDATION_EPISODES = 100
VALIDATION_TASKS = ("GoToLocalS6N3", "GoToLocalS8N4", "GoToLocal")


class TilePolicy:
    """The policy on tile codes instead of pixels: the same function, without drawing every training image.

    A frame is 49 tiles of 23 kinds, so its patch embedding is a sum of rows of a table that holds the embedding of
    each kind of tile in each frame of the history.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.tiles = torch.from_numpy(tile_images()).permute(0, 3, 1, 2).flatten(1).float() / 127.5 - 1.0

    def image_patches(self, codes: Tensor) -> Tensor:
        """Tile codes (B, T, 7, 7) to embedded patches (B, C, 7, 7)."""
        convolution = self.policy.vision.patch_embedding
        weight = convolution.weight.reshape(CHANNELS, FRAMES, -1)
        table = torch.einsum("ctp,kp->tkc", weight, self.tiles).reshape(FRAMES * CODES, CHANNELS)
        slots = codes.flatten(2) + CODES * torch.arange(FRAMES)[:, None]
        one_hot = torch.zeros(len(codes), VIEW * VIEW, FRAMES * CODES, dtype=torch.bfloat16)
        one_hot.scatter_(2, slots.transpose(1, 2), 1.0)
        patches = one_hot @ table.bfloat16() + convolution.bias
        return patches.transpose(1, 2).reshape(-1, CHANNELS, VIEW, VIEW)

    def logits(self, codes: NDArray[np.uint8], actions: NDArray[np.int64], instruction: NDArray[np.int64]) -> Tensor:
        """Logits (B, 3) in float32, computed in bfloat16."""
        with torch.autocast("cpu", torch.bfloat16):
            patches = self.image_patches(torch.from_numpy(codes).long())
            return self.policy.act(patches, torch.from_numpy(actions), torch.from_numpy(instruction)).float()

    @torch.inference_mode()
    def choose(self, episodes: Sequence[Episode]) -> NDArray[np.int64]:
        """The best action of every episode's current state."""
        codes = np.stack([episode.env.view_codes for episode in episodes])
        actions = np.stack([episode.env.past_actions for episode in episodes])
        instruction = np.array([word_ids(episode.env.instruction) for episode in episodes])
        return self.logits(codes, actions, instruction).argmax(dim=1).numpy()


@dataclass
class Trainer:
    """Everything that changes while training.

    Attributes:
        policy: the trained weights.
        average: their exponential moving average, which collects the episodes and is what is saved.
    """

    seed: int
    steps: int
    seconds: float
    policy: Policy = field(init=False)
    average: Policy = field(init=False)
    demonstrations: Demonstrations = field(default_factory=Demonstrations)
    step: int = 0
    episodes: int = 0

    def __post_init__(self) -> None:
        torch.manual_seed(self.seed)
        self.rng = np.random.default_rng(self.seed)
        self.policy = make(None).train()
        self.average = copy.deepcopy(self.policy).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(self.policy.parameters(), betas=(0.9, 0.98), weight_decay=0.02, fused=True)
        self.started = time.monotonic()

    @property
    def progress(self) -> float:
        """Fraction of the training that is done, 1 when either the steps or the time are used up."""
        return max(self.step / self.steps, (time.monotonic() - self.started) / self.seconds)

    def collect(self, episodes: int, noise: float, by_policy: bool) -> None:
        """Add episodes of new seeds, played by the averaged policy or by the expert."""
        tasks = self.rng.choice(list(LADDER), size=episodes, p=list(LADDER.values()))
        starts = [(str(task), self.episodes + index) for index, task in enumerate(tasks)]
        choose = TilePolicy(self.average).choose if by_policy else None
        self.demonstrations.extend(collect(starts, self.rng, choose, noise))
        self.episodes += episodes

    def learn(self) -> tuple[float, float]:
        """One optimizer step; returns loss and agreement with the expert."""
        batch = self.demonstrations.augmented_batch(BATCH, self.rng)
        loss, agreement = self._loss(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
        warm_up = min(1.0, (self.step + 1) / WARM_UP_STEPS)
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, self.progress)))
        for group in self.optimizer.param_groups:
            group["lr"] = PEAK_LEARNING_RATE * warm_up * (0.01 + 0.99 * cosine)
        self.optimizer.step()
        self.step += 1
        self._update_average()
        return loss.item(), agreement

    def _loss(self, batch: Batch) -> tuple[Tensor, float]:
        logits = TilePolicy(self.policy).logits(batch.codes, batch.actions, batch.instruction)
        expert = torch.from_numpy(batch.expert)
        agreement = (logits.argmax(dim=1) == expert).float().mean().item()
        return torch.nn.functional.cross_entropy(logits, expert), agreement

    def _update_average(self) -> None:
        rate = 1 - min(AVERAGE_DECAY, self.step / (self.step + 10))
        for kept, new in zip(self.average.state_dict().values(), self.policy.state_dict().values(), strict=True):
            if kept.dtype.is_floating_point:
                kept.lerp_(new, rate)
            else:
                kept.copy_(new)

    def validate(self, task: str) -> float:
        """Success of the averaged policy on the validation seeds."""
        starts = [(task, VALIDATION_SEED + index) for index in range(VALIDATION_EPISODES)]
        return float(np.mean([episode.success for episode in play(TilePolicy(self.average).choose, starts)]))


def train_round(trainer: Trainer, bar: Progress, task: TaskID) -> dict[str, float]:
    """Train until the next DAgger round, collect it, and measure; returns one row of the training curve."""
    seen: list[tuple[float, float]] = []
    while len(seen) < ROUND_STEPS and trainer.progress < 1:
        seen.append(trainer.learn())
        bar.update(task, completed=trainer.step, loss=seen[-1][0])
    loss, agreement = np.mean(seen, axis=0)
    successes = {name: trainer.validate(name) for name in VALIDATION_TASKS}
    if trainer.progress < 0.95:
        trainer.collect(ROUND_EPISODES, noise=0.1, by_policy=True)
    minutes = (time.monotonic() - trainer.started) / 60
    row = {"minutes": minutes, "step": trainer.step, "states": len(trainer.demonstrations)}
    return row | {"loss": float(loss), "agreement": float(agreement)} | successes


def train(trainer: Trainer, out: Path) -> None:
    """Run the whole training, saving the averaged weights and the curve after every round."""
    columns = (TextColumn("training"), BarColumn(), MofNCompleteColumn(), TextColumn("loss {task.fields[loss]:.3f}"))
    rows: list[dict[str, float]] = []
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn()) as bar:
        task = bar.add_task("train", total=trainer.steps, loss=float("nan"))
        trainer.collect(EXPERT_EPISODES, noise=0.15, by_policy=False)
        while trainer.progress < 1:
            rows.append(train_round(trainer, bar, task))
            bar.console.print({name: round(value, 3) for name, value in rows[-1].items()})
            save_file(trainer.average.state_dict(), out / "weights.safetensors")
            write_curve(rows, out / "training_curve.csv")


def write_curve(rows: Sequence[dict[str, float]], path: Path) -> None:
    """Write one line per round."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows({name: round(value, 4) for name, value in row.items()} for row in rows)


def main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder for the results")
    parser.add_argument("--steps", type=int, default=4_000, help="optimizer steps of the whole training")
    parser.add_argument("--minutes", type=float, default=55.0, help="time limit; the schedule shrinks to fit it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(arguments.seed, arguments.steps, 60 * arguments.minutes)
    train(trainer, arguments.out)
    write_samples(TilePolicy(trainer.average).choose, arguments.out)


if __name__ == "__main__":
    main()
