"""Measure the success of vln-babyai on held-out seeds, beside the chance floor and a wrong-instruction control."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from environment import render
from numpy.typing import NDArray
from policy import WEIGHTS, make
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rollout import LADDER, Chooser, Episode, play, random_mover, word_ids
from torch import nn

FIRST_SEED = 1_000_000  # training seeds count up from 0 and stay far below
CONTROL_TASKS = ("GoToLocalS6N3", "GoToLocalS8N4", "GoToLocal")
QUANTILE = 1.959964  # of the normal distribution, for a two-sided 95 % interval


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success probability."""
    rate = successes / trials
    centre = rate + QUANTILE**2 / (2 * trials)
    spread = QUANTILE * np.sqrt(rate * (1 - rate) / trials + QUANTILE**2 / (4 * trials**2))
    scale = 1 + QUANTILE**2 / trials
    return (centre - spread) / scale, (centre + spread) / scale


def best_action(policy: nn.Module) -> Chooser:
    """Choose the argmax of the policy's float32 logits on rendered images."""

    @torch.inference_mode()
    def choose(episodes: Sequence[Episode]) -> NDArray[np.int64]:
        image = render(np.stack([episode.env.view_codes for episode in episodes]))
        actions = np.stack([episode.env.past_actions for episode in episodes])
        instruction = np.array([word_ids(episode.env.instruction) for episode in episodes])
        logits = policy(torch.from_numpy(image), torch.from_numpy(actions), torch.from_numpy(instruction))
        return logits.argmax(dim=1).numpy()

    return choose


def measure(choose: Chooser, task: str, instruction: str, count: int) -> tuple[str, ...]:
    """Play `count` held-out episodes; returns the cells success, interval and mean length."""
    starts = [(task, FIRST_SEED + index) for index in range(count)]
    episodes = play(choose, starts, instruction)
    successes = sum(episode.success for episode in episodes)
    low, high = wilson_interval(successes, count)
    length = np.mean([episode.length for episode in episodes])
    return f"{100 * successes / count:.1f} %", f"{100 * low:.1f} - {100 * high:.1f} %", f"{length:.1f}"


def main() -> None:
    """Parse the command line, measure and print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument("--episodes", type=int, default=1_000, help="episodes of each row")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    policy = best_action(make(arguments.weights))
    runs = [("policy", policy, task, "right") for task in LADDER]
    runs += [("policy", policy, task, "wrong") for task in CONTROL_TASKS]
    runs += [("random moves", random_mover, task, "right") for task in CONTROL_TASKS]
    columns = ("who", "task", "instruction", "n", "success", "95 % interval", "mean steps")
    table = Table(*columns, title=f"seeds from {FIRST_SEED}")
    started = time.monotonic()
    for who, choose, task, instruction in track(runs, "measuring"):
        cells = measure(choose, task, instruction, arguments.episodes)
        table.add_row(who, task, instruction, str(arguments.episodes), *cells)
    table.caption = f"{time.monotonic() - started:.0f} s, {arguments.threads} thread(s)"
    Console().print(table)


if __name__ == "__main__":
    main()
