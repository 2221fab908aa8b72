"""Reproduces the policy: demonstrations, flow matching with DAgger from the trunk of vla-metaworld, sample files.

Run `python train.py --out DIR --work DIR --threads 2`; every file of the policy lands in `--out`. Frames and
checkpoints stay in `--work`, and a run that was interrupted goes on from there.
"""

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import neighbor
import numpy as np
import torch
from batches import Batches, Budget, reuse_large_buffers
from collection import Display, gather
from demonstrations import Frames
from flow_learning import FlowLearner
from rich.console import Console
from script import first_seed, run, training_options, write_curve

DEMONSTRATIONS = 80
DAGGER_EPISODES = 15
DAGGER_AT = (0.4, 0.7)
STEPS = 1800
SHARED_FILES = ("vocabulary.json", "statistics.json")
RECORDINGS = ("calibration.npz", "evaluation.npz")


def kept(path: Path, collect: Callable[[], Frames]) -> Frames:
    """Returns the frames of a file, collected before if there is none."""
    if not path.exists():
        frames = collect()
        np.savez(path.with_suffix(".new.npz"), **vars(frames))
        path.with_suffix(".new.npz").replace(path)
    with np.load(path) as arrays:
        return Frames(**arrays)


def thin(source: Path, target: Path) -> None:
    """Copies three in four of the recorded samples."""
    with np.load(source) as arrays:
        rows = np.arange(len(arrays["image"])) % 4 != 3
        np.savez_compressed(target, **{name: array[rows] for name, array in arrays.items()})


def copy_shared(out: Path) -> None:
    """Takes over what the trunk was trained with: words, statistics, and samples of the recorded observations."""
    for name in SHARED_FILES:
        shutil.copyfile(neighbor.NEIGHBOR / name, out / name)
    for name in RECORDINGS:
        thin(neighbor.NEIGHBOR / name, out / name)


def learn(learner: FlowLearner, display: Display, options: Any) -> None:
    """Trains with DAgger rounds at fixed shares of the steps."""
    frames = kept(
        options.work / "demonstrations.npz",
        lambda: gather(display, "demonstrations", first_seed(options.seed), DEMONSTRATIONS, options.threads),
    )
    checkpoint = options.work / "checkpoint.pt"
    state = learner.resume(checkpoint)
    for number, until in enumerate((*DAGGER_AT, 1.0), start=1):
        batches = Batches.read(frames, options.out, options.seed)
        if state is not None:
            batches.restore(state)
        with display.bar("training", options.steps) as move:
            learner.train(batches, until, lambda step, loss: move(step, f"loss {loss:.3f}"), checkpoint)
        learner.save(options.out / "weights.safetensors")
        if until < 1.0:
            added = kept(
                options.work / f"dagger_{number}.npz",
                lambda number=number: gather(
                    display, f"DAgger round {number}", first_seed(options.seed, number), DAGGER_EPISODES,
                    options.threads, options.out,
                ),
            )  # fmt: skip
            frames = Frames.join([frames, added])


def reproduce(options: argparse.Namespace, console: Console) -> None:
    """Runs every stage and writes all generated files to `options.out`."""
    torch.set_num_threads(options.train_threads)
    reuse_large_buffers()
    copy_shared(options.out)
    learner = FlowLearner(options.seed, Budget(options.steps, options.minutes), neighbor.NEIGHBOR)
    learn(learner, Display(console), options)
    write_curve(options.out, learner.curve)


def main() -> None:
    """Command line."""
    parser = training_options(__doc__, Path(__file__).parent, STEPS)
    parser.add_argument("--work", type=Path, required=True, help="folder for frames and checkpoints (about 1 GB)")
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="upper limit; cut short, no run is repeated"
    )
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    run(options, reproduce)


if __name__ == "__main__":
    main()
