"""What the training scripts of every policy on these tasks have in common: options, the curve, the success tables."""

import argparse
import csv
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from closed_loop import evaluate, show
from rich.console import Console

SEED_STRIDE = 10_000


def training_options(about: str, folder: Path, steps: int) -> argparse.ArgumentParser:
    """Options of a training whose files land in a folder; a script adds its own."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--out", type=Path, default=folder, help="folder for the files of the policy")
    parser.add_argument("--steps", type=int, default=steps, help="optimiser steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2, help="worker processes for collection and evaluation")
    parser.add_argument("--train-threads", type=int, default=1, help="torch threads of the optimiser")
    parser.add_argument("--evaluate", action="store_true", help="print the success tables afterwards")
    return parser


def first_seed(seed: int, dagger_round: int = 0) -> int:
    """Seed of the first demonstration, or of the first episode of a DAgger round."""
    return (seed + 1) * 10 * SEED_STRIDE + dagger_round * SEED_STRIDE


def write_curve(out: Path, curve: Sequence[tuple[int, float, float]]) -> None:
    """Writes training_curve.csv."""
    with (out / "training_curve.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("step", "minutes", "loss"), *curve])


def run(options: argparse.Namespace, reproduce: Callable[[argparse.Namespace, Console], None]) -> None:
    """Trains, and evaluates afterwards where that is asked for."""
    os.environ.setdefault("LP_NUM_THREADS", "1")  # the software renderer of each worker process
    options.out.mkdir(parents=True, exist_ok=True)
    console = Console()
    reproduce(options, console)
    if options.evaluate:
        for instruction, episodes in (("right", 64), ("wrong", 32)):
            show(evaluate(options.out, episodes, instruction, options.threads), f"{instruction} instruction", console)
