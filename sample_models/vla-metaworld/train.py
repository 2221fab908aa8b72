"""Reproduces the policy from nothing: demonstrations, statistics, training with DAgger, sample files.

Run `python train.py --out DIR --threads 2`; every generated file lands in DIR.
"""

import argparse
from pathlib import Path
from typing import Any

import closed_loop
import environment as tasks
import torch
from batches import Batches, Budget, reuse_large_buffers
from collection import Display, gather, sample, write_json, write_samples
from demonstrations import Frames
from learning import Learner
from rich.console import Console
from runtime import build_vocabulary, summarise
from script import first_seed, run, training_options, write_curve

DEMONSTRATIONS = 80
DAGGER_EPISODES = 25
DAGGER_AT = (0.3, 0.5, 0.7)
STEPS = 4500
EVALUATION_EPISODES = 8
CALIBRATION_SAMPLES = 128
EVALUATION_SAMPLES = 256


def learn(learner: Learner, display: Display, frames: Frames, options: Any) -> None:
    """Trains with DAgger rounds at fixed shares of the budget."""
    for number, until in enumerate((*DAGGER_AT, 1.0), start=1):
        batches = Batches.read(frames, options.out, options.seed)
        with display.bar("training", learner.budget.steps) as move:
            learner.run(batches, until, lambda step, loss: move(step, f"loss {loss:.3f}"))
        learner.save(options.out / "weights.safetensors")
        if until < 1.0:
            first, title = first_seed(options.seed, number), f"DAgger round {number}"
            added = gather(display, title, first, DAGGER_EPISODES, options.threads, options.out)
            frames = Frames.join([frames, added])


def reproduce(options: argparse.Namespace, console: Console) -> None:
    """Runs every stage and writes all generated files to `options.out`."""
    torch.set_num_threads(options.train_threads)
    reuse_large_buffers()
    display, budget = Display(console), Budget(options.steps, options.minutes)
    frames = gather(display, "demonstrations", first_seed(options.seed), DEMONSTRATIONS, options.threads)
    console.print(f"{len(frames)} demonstration frames")
    words = build_vocabulary([sentence for wordings in tasks.INSTRUCTIONS.values() for sentence in wordings])
    statistics = {"proprio": summarise(frames.proprio), "action": summarise(frames.action)}
    write_json(options.out / "vocabulary.json", words)
    write_json(options.out / "statistics.json", statistics)
    write_samples(options.out / "calibration.npz", sample(frames, CALIBRATION_SAMPLES, options.seed), False)
    held_out = gather(display, "evaluation data", closed_loop.HELD_OUT_SEED * 2, EVALUATION_EPISODES, options.threads)
    write_samples(options.out / "evaluation.npz", sample(held_out, EVALUATION_SAMPLES, options.seed), True)
    learner = Learner(options.seed, budget)
    learn(learner, display, frames, options)
    write_curve(options.out, learner.curve)


def main() -> None:
    """Command line."""
    parser = training_options(__doc__, Path(__file__).parent, STEPS)
    parser.add_argument("--minutes", type=float, default=55.0, help="upper limit for collection and training")
    run(parser.parse_args(), reproduce)


if __name__ == "__main__":
    main()
