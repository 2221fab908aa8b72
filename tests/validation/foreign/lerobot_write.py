"""Write datasets with LeRobot, and what LeRobot itself reads of them; run in its own interpreter.

LEROBOT_PYTHON tests/validation/foreign/lerobot_write.py FOLDER
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

HZ, LENGTHS, TASKS = 10, (35, 50, 20, 44), ("pick the cube", "place the cube")
SIZES = {"top": (96, 128, 3), "wrist": (64, 64, 3)}


def picture(random: np.random.Generator, size: tuple[int, int, int], step: int) -> np.ndarray:
    """A gradient that moves, with a little noise."""
    height, width, _ = size
    pixels = np.zeros(size, np.float32)
    pixels[:, :, 0] = (np.arange(width)[None, :] * 2 + step * 5) % 256
    pixels[:, :, 1] = (np.arange(height)[:, None] * 2 + step * 3) % 256
    pixels[:, :, 2] = step * 4 % 256
    return np.clip(pixels + random.normal(0, 2, size), 0, 255).astype(np.uint8)


def add(dataset: LeRobotDataset, frame: dict[str, np.ndarray], task: str) -> None:
    """Add a step; releases with version 2.1 of the format (0.3) take the instruction by itself."""
    if "task" in inspect.signature(dataset.add_frame).parameters:
        dataset.add_frame(frame, task)
    else:
        dataset.add_frame({**frame, "task": task})


def write(folder: Path, *, videos: bool) -> None:
    random = np.random.default_rng(0)
    kind = "video" if videos else "image"
    features = {f"observation.images.{name}": {"dtype": kind, "shape": size, "names": ["height", "width", "channels"]}
                for name, size in SIZES.items()}  # fmt: skip
    features["observation.state"] = {"dtype": "float32", "shape": (7,), "names": [f"joint_{at}" for at in range(7)]}
    features["action"] = {"dtype": "float32", "shape": (7,), "names": [f"joint_{at}" for at in range(7)]}
    features["next.done"] = {"dtype": "bool", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create("vlatool/test", HZ, features, root=folder, use_videos=videos)
    for episode, length in enumerate(LENGTHS):
        for step in range(length):
            frame = {f"observation.images.{name}": picture(random, size, step + 7 * episode)
                     for name, size in SIZES.items()}  # fmt: skip
            frame |= {name: random.normal(size=7).astype(np.float32) for name in ("observation.state", "action")}
            frame["next.done"] = np.array([step == length - 1])
            add(dataset, frame, TASKS[episode % 2])
        dataset.save_episode()
    if hasattr(dataset, "finalize"):
        dataset.finalize()


def read_back(folder: Path) -> None:
    """Store what LeRobot reads, a chunk of 8 actions with it."""
    times = {"action": [step / HZ for step in range(8)]}
    dataset = LeRobotDataset("vlatool/test", root=folder, delta_timestamps=times, video_backend="pyav")
    rows = [0, 34, 35, 60, 84, 85, 104, 105, 148]
    items = [dataset[row] for row in rows]
    values = {name: np.stack([np.asarray(item[name]) for item in items]) for name in items[0] if name != "task"}
    np.savez(folder.with_suffix(".npz"), rows=rows, task=[item["task"] for item in items], **values)


if __name__ == "__main__":
    for videos in (True, False):
        target = Path(sys.argv[1]) / ("videos" if videos else "pictures")
        write(target, videos=videos)
        read_back(target)
