"""LeRobot checkpoints through one command each, held against ``select_action`` over an episode.

    python tests/validation/foreign/lerobot_checkpoints.py --python ~/lerobot/bin/python [--small] [--steps 50]

``--python`` has LeRobot 0.6 (``pip install 'lerobot[diffusion,smolvla]==0.6.1'``, Python 3.12); it needs no vlatool.
For each policy: LeRobot makes a checkpoint with random weights and plays an episode with its own processors; then
``vlatool export onnx CHECKPOINT --python ...`` and ``vlatool.load`` here, fed the same observations and noise. Prints
the relative L2 distance of the action chunks, and exits 1 when one is above 1e-4.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import vlatool

KINDS = ("act", "diffusion-ddim", "diffusion-ddpm", "smolvla", "pi0", "pi05", "act-relative", "diffusion-ddim-relative")
LIMIT = 1e-4
MAKE = Path(__file__).with_name("_lerobot_checkpoints.py")
SMALL = Path(__file__).with_name("_small_pi0.py")


def errors(bundle: Path, recorded: Path) -> list[float]:
    """Return the relative L2 distance of each executed chunk from what LeRobot executed."""
    policy, episode = vlatool.load(bundle), np.load(recorded)
    drawn_name = next((name for step in policy.program.steps for name in step.noise), "")
    execute, drawn, found = policy.spec.executed_actions, 0, []
    for step in range(len(episode["action"])):
        moment = {each.name: _value(episode[each.name][step]) for each in policy.spec.inputs}
        if step % execute:
            policy.observe(moment)
            continue
        count = int(episode["drawn"][step])
        first, *fresh = [episode[f"noise_{drawn + index}"] for index in range(count)] or [None]
        drawn += count
        noise = None if first is None else {drawn_name: first, **({"fresh": np.stack(fresh)} if fresh else {})}
        if fresh:  # the last step of DDPM draws none
            steps = next(each.repeat for each in policy.program.steps if each.repeat > 1)
            noise["fresh"] = np.concatenate([noise["fresh"], np.zeros((steps - len(fresh), *first.shape), np.float32)])
        expected = episode["action"][step : step + execute]
        got = policy.infer(moment, noise=noise).chunk[: len(expected)]
        found.append(float(np.linalg.norm(got - expected) / np.linalg.norm(expected)))
    return found


def small_pi0(python: str, place: Path) -> str:
    """Return a program that runs a script as a Python does, with pi0 and pi0.5 in a small size."""
    program = place / "small-pi0"
    program.write_text(f'#!/bin/sh\nexec "{python}" "{SMALL}" "$@"\n')
    program.chmod(0o755)
    return str(program)


def _value(recorded: Any) -> Any:
    return str(recorded) if recorded.dtype.kind == "U" else recorded


def main(arguments: list[str]) -> int:
    """Print a row for each kind of policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", required=True)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("kinds", nargs="*", default=KINDS)
    asked = parser.parse_args(arguments)
    worst = 0.0
    print("| policy | chunks | error, median | error, largest |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place:
        for kind in asked.kinds:
            folder = Path(place) / kind
            sizes = ["--steps", str(asked.steps), *(["--small"] if asked.small else [])]
            python = small_pi0(asked.python, Path(place)) if asked.small and kind.startswith("pi0") else asked.python
            subprocess.run([python, MAKE, kind, folder, *sizes], check=True, capture_output=True)
            command = ["export", "onnx", folder / "checkpoint", "-o", folder / "bundle", "--python", python]
            subprocess.run([sys.executable, "-m", "vlatool", *command], check=True, capture_output=True)
            found = errors(folder / "bundle", folder / "episode.npz")
            worst = max(worst, *found)
            print(f"| {kind} | {len(found)} | {np.median(found):.1e} | {max(found):.1e} |", flush=True)
    return int(not worst <= LIMIT)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
