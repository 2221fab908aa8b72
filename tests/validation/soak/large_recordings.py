"""Run vlatool's commands on a small policy with gigabytes of recordings; print how much the cache and memory grew.

    python tests/validation/soak/large_recordings.py SCRATCH --gigabytes 2.8 --frames 10000

SCRATCH is made, needs twice the recordings' size of room, and is removed again. ``optimize`` runs with two candidates
into a cache of its own, then each further command on what it made. Printed are, for each command, what the cache holds
beyond one copy of the recordings, and the largest peak of resident memory (VmHWM) of any of its processes. Exits 1 when
the cache grew by more than ``--most-growth-mb``, or a process by more than ``--most-rss-mb``, or a command failed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

POLICY_YAML = """\
schema: 1
name: watcher
version: 1.0.0
source: policy.py:make
spec:
  inputs:
    - {{name: image, shape: [1, {side}, {side}, 3], dtype: uint8, unit: rgb}}
    - {{name: state, shape: [1, 8], unit: "1"}}
  outputs:
    - {{name: action, shape: [1, 4, 2], unit: [m, m], labels: [dx, dy]}}
  control_hz: 10
  chunk: 4
"""
POLICY_PY = """\
import torch
from torch import nn


class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.see = nn.Sequential(nn.Conv2d(3, 8, 8, 8), nn.ReLU(), nn.AdaptiveAvgPool2d(9), nn.Flatten())
        self.think = nn.Sequential(nn.Linear(8 * 81 + 8, 256), nn.ReLU(), nn.Linear(256, 8))

    def forward(self, image, state):
        seen = self.see(image.permute(0, 3, 1, 2).float() / 255)
        return self.think(torch.cat([seen, state], 1)).reshape(1, 4, 2)


def make():
    torch.manual_seed(0)
    return Policy()
"""
RECIPE = """\
candidates:
  int8: [quantize.static_int8: {}]
  dynamic: [quantize.dynamic_int8: {}]
"""
BLOCK = 64


@dataclass(frozen=True)
class Seen:
    """What one command took: exit code, seconds, and the largest peaks of a process and of all together in MB."""

    code: int
    seconds: float
    peak_mb: float
    together_mb: float


def write_policy(folder: Path, frames: int, size: float) -> int:
    """Write a policy with a calibration and an evaluation recording of ``frames`` frames; return their bytes."""
    side = max(9 * 8, int((size / 2 / frames / 3) ** 0.5))
    folder.mkdir(parents=True)
    (folder / "policy.yaml").write_text(POLICY_YAML.format(side=side))
    (folder / "policy.py").write_text(POLICY_PY)
    for seed, name in enumerate(("calibration.npz", "evaluation.npz")):
        write_recording(folder / name, frames, side, seed)
    return sum(path.stat().st_size for path in folder.glob("*.npz"))


def write_recording(path: Path, frames: int, side: int, seed: int) -> None:
    """Write random frames a few at a time, as ``np.savez`` would."""
    random = np.random.default_rng(seed)
    small = {
        "state": random.normal(size=(frames, 8)).astype(np.float32),
        "action": random.normal(size=(frames, 4, 2)).astype(np.float32),
        "episode": np.arange(frames) // 100,
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, values in small.items():
            with archive.open(f"{name}.npy", "w") as stream:
                np.lib.format.write_array(stream, values)
        with archive.open("image.npy", "w", force_zip64=True) as stream:
            header = {"descr": "|u1", "fortran_order": False, "shape": (frames, side, side, 3)}
            np.lib.format.write_array_header_1_0(stream, header)
            for first in range(0, frames, BLOCK):
                shape = (min(BLOCK, frames - first), side, side, 3)
                stream.write(random.integers(0, 256, shape, np.uint8).tobytes())


def used_mb(folder: Path) -> float:
    """Return the megabytes that a directory takes on the disk, each file once."""
    found = {(state.st_dev, state.st_ino): state.st_blocks * 512 for state in map(os.lstat, folder.rglob("*"))}
    return sum(found.values()) / 1e6


def family(root: int) -> Iterator[int]:
    """Yield a process and all that descend from it."""
    yield root
    try:
        children = Path(f"/proc/{root}/task/{root}/children").read_text().split()
        threads = [entry.name for entry in Path(f"/proc/{root}/task").iterdir() if entry.name != str(root)]
        for thread in threads:
            children += Path(f"/proc/{root}/task/{thread}/children").read_text().split()
    except OSError:
        return
    for child in children:
        yield from family(int(child))


def memory_mb(process: int) -> tuple[float, float]:
    """Return the peak and the present resident memory of a process; zeros once it is gone."""
    try:
        lines = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
        return tuple(int(lines[name].split()[0]) / 1024 for name in ("VmHWM", "VmRSS"))  # type: ignore[return-value]
    except (OSError, KeyError, ValueError):
        return 0.0, 0.0


def watched(command: Sequence[str], environment: dict[str, str], log: Path) -> Seen:
    """Run a command and watch the memory of all its processes."""
    start, peak, together = time.monotonic(), 0.0, 0.0
    with log.open("ab") as stream, subprocess.Popen(command, env=environment, stdout=stream, stderr=stream) as running:
        while running.poll() is None:
            found = [memory_mb(process) for process in family(running.pid)]
            peak = max(peak, *(highest for highest, _ in found))
            together = max(together, sum(now for _, now in found))
            time.sleep(0.05)
    return Seen(running.returncode, time.monotonic() - start, peak, together)


def commands(place: Path) -> dict[str, list[str]]:
    """Return name -> arguments of all commands, ``optimize`` first."""
    policy, exported = str(place / "policy"), str(place / "exported")
    few = ["--iterations", "20", "--episodes", "0", "--workers", "1", "--max-drop", "100%"]
    return {
        "optimize": ["optimize", policy, "--recipe", str(place / "recipe.yaml"), "-o", str(place / "out"), *few],
        "optimize again": ["optimize", policy, "--recipe", str(place / "recipe.yaml"), "-o", str(place / "out2"), *few],
        "export": ["export", policy, "-o", exported],
        "evaluate": ["evaluate", "recorded", exported],
        "benchmark": ["benchmark", exported, "--iterations", "20"],
        "explain": ["explain", str(place / "out"), "--data", str(place / "policy/evaluation.npz")],
    }


def main() -> int:
    """Run all commands; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scratch", type=Path)
    parser.add_argument("--gigabytes", type=float, default=2.8)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--only", default="", help="names of commands, with commas")
    parser.add_argument("--most-growth-mb", type=float, default=100)
    parser.add_argument("--most-rss-mb", type=float, default=600)
    parser.add_argument("--keep", action="store_true", help="leave SCRATCH as it is")
    asked = parser.parse_args()
    asked.scratch.mkdir(parents=True)
    try:
        return run(asked)
    finally:
        if not asked.keep:
            shutil.rmtree(asked.scratch)


def run(asked: argparse.Namespace) -> int:
    """Write the policy, run the commands, print what they took."""
    place, cache = asked.scratch, asked.scratch / "cache"
    recorded = write_policy(place / "policy", asked.frames, asked.gigabytes * 1e9) / 1e6
    (place / "recipe.yaml").write_text(RECIPE)
    environment = {**os.environ, "VLATOOL_CACHE": str(cache), "TMPDIR": str(place)}
    print(f"{recorded:,.0f} MB of recordings, {2 * asked.frames:,} frames", flush=True)
    bad = False
    for name, arguments in commands(place).items():
        if asked.only and name not in asked.only.split(","):
            continue
        seen = watched([sys.executable, "-m", "vlatool", *arguments], environment, place / "log.txt")
        growth = used_mb(cache) - recorded if cache.is_dir() else 0.0
        row = {"command": name, "exit": seen.code, "seconds": round(seen.seconds), "cache_growth_mb": round(growth, 1),
               "peak_rss_mb": round(seen.peak_mb), "together_mb": round(seen.together_mb)}  # fmt: skip
        print(json.dumps(row), flush=True)
        failed = seen.code not in (0, 1, 5)
        bad |= failed or growth > asked.most_growth_mb or seen.peak_mb > asked.most_rss_mb
        if failed:
            print((place / "log.txt").read_text(errors="replace")[-3000:])
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
