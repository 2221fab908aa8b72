"""Reproduces the policy from nothing: demonstrations, statistics, training with DAgger, sample files.

Run `python train.py --out DIR --threads 2`; every generated file lands in DIR.
"""

import argparse
import csv
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import environment as tasks
import evaluate
import numpy as np
import torch
from demonstrations import Frames, collect
from learning import Batches, Budget, Learner, reuse_large_buffers
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from runtime import build_vocabulary, summarise

DEMONSTRATIONS = 80
DAGGER_EPISODES = 25
DAGGER_AT = (0.3, 0.5, 0.7)
STEPS = 4500
EVALUATION_EPISODES = 8
CALIBRATION_SAMPLES = 128
EVALUATION_SAMPLES = 256
SEED_STRIDE = 10_000
Json = dict[str, Any]


class Display:
    """Progress bars for the two kinds of work."""

    def __init__(self, console: Console) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, console=console)

    @contextmanager
    def bar(self, description: str, total: int) -> Iterator[Callable[[int | None, str], None]]:
        """A bar; call the yielded function with the new position (None: one further) and a suffix."""
        with self._progress:
            bar = self._progress.add_task(description, total=total)

            def move(position: int | None = None, suffix: str = "") -> None:
                if position is None:
                    self._progress.advance(bar)
                else:
                    self._progress.update(bar, completed=position, description=f"{description} {suffix}")

            yield move
            self._progress.remove_task(bar)


def gather(
    display: Display, title: str, first_seed: int, episodes: int, threads: int, folder: Path | None = None
) -> Frames:
    """Collects frames of every task behind a progress bar."""
    jobs = len(tasks.TASKS) * -(-episodes // 10)
    with display.bar(title, jobs) as move:
        return collect(first_seed, episodes, threads, lambda: move(None, ""), folder)


def write_json(path: Path, value: Json) -> None:
    """Writes a JSON file with a final newline."""
    path.write_text(json.dumps(value, indent=2) + "\n")


def sample(frames: Frames, count: int, seed: int) -> Frames:
    """Draws `count` frames, the same number per task, spread over the frames of each task in collection order."""
    generator = np.random.default_rng(seed)
    share = count // len(tasks.TASKS)
    chosen = []
    for task in range(len(tasks.TASKS)):
        parts = np.array_split(np.flatnonzero(frames.task == task), share)
        chosen += [generator.choice(part) for part in parts]
    return frames.select(np.array(chosen))


def write_samples(path: Path, frames: Frames, with_episode: bool) -> None:
    """Saves raw observations and expert chunks; the wording of the instruction alternates."""
    told = [tasks.INSTRUCTIONS[tasks.TASKS[task]][row % 2] for row, task in enumerate(frames.task)]
    arrays = {
        "image": frames.image,
        "proprio": frames.proprio,
        "instruction": np.array(told),
        "action": frames.action,
    }
    if with_episode:
        arrays["episode"] = frames.episode.astype(np.int64)
    np.savez_compressed(path, **arrays)


def learn(learner: Learner, display: Display, frames: Frames, words: Json, statistics: Json, options: Any) -> None:
    """Trains with DAgger rounds at fixed shares of the budget."""
    for number, until in enumerate((*DAGGER_AT, 1.0), start=1):
        batches = Batches(frames, words, statistics, options.seed)
        with display.bar("training", learner.budget.steps) as move:
            learner.run(batches, until, lambda step, loss: move(step, f"loss {loss:.3f}"))
        learner.save(options.out / "weights.safetensors")
        if until < 1.0:
            first = (options.seed + 1) * 10 * SEED_STRIDE + number * SEED_STRIDE
            title = f"DAgger round {number}"
            added = gather(display, title, first, DAGGER_EPISODES, options.threads, options.out)
            frames = Frames.join([frames, added])


def reproduce(options: argparse.Namespace, console: Console) -> None:
    """Runs every stage and writes all generated files to `options.out`."""
    torch.set_num_threads(options.train_threads)
    reuse_large_buffers()
    display, budget = Display(console), Budget(options.steps, options.minutes)
    first = (options.seed + 1) * 10 * SEED_STRIDE
    frames = gather(display, "demonstrations", first, DEMONSTRATIONS, options.threads)
    console.print(f"{len(frames)} demonstration frames")
    words = build_vocabulary([sentence for wordings in tasks.INSTRUCTIONS.values() for sentence in wordings])
    statistics = {"proprio": summarise(frames.proprio), "action": summarise(frames.action)}
    write_json(options.out / "vocabulary.json", words)
    write_json(options.out / "statistics.json", statistics)
    write_samples(options.out / "calibration.npz", sample(frames, CALIBRATION_SAMPLES, options.seed), False)
    held_out = gather(display, "evaluation data", evaluate.HELD_OUT_SEED * 2, EVALUATION_EPISODES, options.threads)
    write_samples(options.out / "evaluation.npz", sample(held_out, EVALUATION_SAMPLES, options.seed), True)
    learner = Learner(options.seed, budget)
    learn(learner, display, frames, words, statistics, options)
    with (options.out / "training_curve.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("step", "minutes", "loss"), *learner.curve])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder for all generated files")
    parser.add_argument("--minutes", type=float, default=55.0, help="upper limit for collection and training")
    parser.add_argument("--steps", type=int, default=STEPS, help="optimiser steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2, help="worker processes for collection and evaluation")
    parser.add_argument("--train-threads", type=int, default=1, help="torch threads of the optimiser")
    parser.add_argument("--evaluate", action="store_true", help="print the success tables afterwards")
    options = parser.parse_args()
    os.environ.setdefault("LP_NUM_THREADS", "1")  # the software renderer of each worker process
    options.out.mkdir(parents=True, exist_ok=True)
    console = Console()
    reproduce(options, console)
    if options.evaluate:
        for instruction, episodes in (("right", 64), ("wrong", 32)):
            results = evaluate.evaluate(options.out, episodes, instruction, options.threads)
            evaluate.show(results, f"{instruction} instruction", console)


if __name__ == "__main__":
    main()
