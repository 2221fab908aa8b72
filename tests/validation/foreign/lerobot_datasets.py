"""Hold the reader of LeRobot's datasets against LeRobot itself, which writes and reads the same datasets.

python tests/validation/foreign/lerobot_datasets.py --python LEROBOT_PYTHON -o out/lerobot-datasets
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import read_recording

WRITE = Path(__file__).with_name("lerobot_write.py")
CHUNK = 8
SPEC = PolicySpec(
    (
        TensorSpec("top", (1, 96, 128, 3), "uint8"),
        TensorSpec("wrist", (1, 64, 64, 3), "uint8"),
        TensorSpec("state", (1, 7)),
        TensorSpec("task", (1, 8), "int64", kind="text", tokenizer="words.json", max_tokens=8),
    ),
    (TensorSpec("action", (1, CHUNK, 7)),),
    10.0,
    CHUNK,
)


def compare(folder: Path) -> dict[str, Any]:
    """Return the largest difference of each part over the rows that LeRobot read; pictures in steps of 255."""
    recording = read_recording(folder, SPEC)
    with np.load(folder.with_suffix(".npz")) as theirs:
        rows = theirs["rows"].tolist()
        differences: dict[str, Any] = {"steps": len(recording), "episodes": len(np.unique(recording.episodes))}
        for name in ("top", "wrist"):
            pixels = theirs[f"observation.images.{name}"].transpose(0, 2, 3, 1) * 255
            differences[name] = float(np.abs(recording.inputs[name][rows] - pixels).max())
        differences["state"] = float(np.abs(recording.inputs["state"][rows] - theirs["observation.state"]).max())
        differences["action"] = float(np.abs(recording.actions[rows] - theirs["action"]).max())
        padded = theirs["action_is_pad"].any(axis=1)
        differences["padding"] = int(np.count_nonzero(recording.padded[rows] != padded))
        differences["task"] = sum(map(str.__ne__, recording.inputs["task"][rows].tolist(), theirs["task"].tolist()))
    return differences


def main() -> int:
    """Write, compare, print; 1 when anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", required=True, help="interpreter with lerobot[dataset]")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/lerobot-datasets"))
    arguments = parser.parse_args()
    if not (arguments.output / "pictures.npz").exists():
        arguments.output.mkdir(parents=True, exist_ok=True)
        subprocess.run([arguments.python, WRITE, arguments.output], check=True)
    found = {kind: compare(arguments.output / kind) for kind in ("videos", "pictures")}
    for kind, differences in found.items():
        print(kind, differences)
    return int(any(value > 1e-3 for each in found.values() for name, value in each.items()
                   if name not in ("steps", "episodes")))  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
