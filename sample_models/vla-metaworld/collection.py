"""Frames behind a progress bar, and the sample files that are drawn from them."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import environment as tasks
import numpy as np
from demonstrations import Frames, collect
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

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
