"""OpenVLA checkpoints through one command each, held against timm and transformers (greedy ``generate``).

    python tests/validation/foreign/openvla_checkpoints.py --python PYTHON [--observations 50] [dinosiglip siglip ...]

``--python`` has timm 0.9.16, transformers and torchvision; it needs no vlatool. For each kind of towers: that Python
makes a small checkpoint with random weights, laid out as openvla/openvla-7b is, and plays it; then ``vlatool export
onnx CHECKPOINT`` and ``vlatool.load`` here, fed the same frames and instructions. Prints how many of the token rows are
equal, and the relative L2 distance of the actions; exits 1 when a token differs or a distance is above 1e-4.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import vlatool

KINDS = ("dinosiglip", "siglip", "dinoclip")
LIMIT = 1e-4
MAKE = Path(__file__).with_name("_openvla_reference.py")


def compare(bundle: Path, recorded: Path) -> tuple[int, list[float]]:
    """Return how many observations have equal tokens, and the distance of each action."""
    policy, episode = vlatool.load(bundle), np.load(recorded)
    equal, distances = 0, []
    rows = zip(*(episode[name] for name in ("image", "instruction", "tokens", "action")), strict=True)
    for image, instruction, tokens, action in rows:
        got = policy.infer({"image": image, "instruction": str(instruction)})
        equal += bool((got.outputs["tokens"][0] == tokens).all())
        distances.append(float(np.linalg.norm(got.chunk[0] - action) / np.linalg.norm(action)))
    return equal, distances


def main(arguments: list[str]) -> int:
    """Print a row for each kind of towers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", required=True)
    parser.add_argument("--observations", type=int, default=50)
    parser.add_argument("kinds", nargs="*", default=KINDS)
    asked = parser.parse_args(arguments)
    right = True
    print("| towers | observations | equal tokens | error of the action, median | largest |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place:
        for kind in asked.kinds:
            folder = Path(place) / kind
            made = [asked.python, MAKE, folder, "--towers", kind, "--observations", str(asked.observations)]
            subprocess.run(made, check=True, capture_output=True)
            command = ["export", "onnx", folder / "checkpoint", "-o", folder / "bundle"]
            subprocess.run([sys.executable, "-m", "vlatool", *command], check=True, capture_output=True)
            equal, found = compare(folder / "bundle", folder / "episode.npz")
            right &= equal == len(found) and max(found) <= LIMIT
            print(f"| {kind} | {len(found)} | {equal} | {np.median(found):.1e} | {max(found):.1e} |", flush=True)
    return int(not right)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
