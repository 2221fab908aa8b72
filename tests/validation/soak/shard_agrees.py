"""How far trainings whose processes hold parts of the weights are from those of one process, for several policies.

``python tests/validation/soak/shard_agrees.py`` writes small policies (run in batches, row by row, in Euler steps over
two graphs, and traced by ``prune structured``), prunes each, and distils it in one process and in two with ``--shard``.
Prints the largest relative difference of a step's loss, and the relative L2 difference of the weights. Names choose
among them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from _deep import write_deep
from _flow import write_flow
from safetensors.numpy import load_file

from vlatool.machine.processes import import_path

BATCHED = ("reshape(1, 4, 2)", "reshape(-1, 4, 2)")
CASES = {
    "batches": (lambda place: write_deep(place, BATCHED, layers=3), ["neurons", "--ratio", "0.5"]),
    "rows": (lambda place: write_deep(place, layers=3), ["neurons", "--ratio", "0.5"]),
    "flow": (write_flow, ["neurons", "--ratio", "0.5"]),
    "traced": (lambda place: write_deep(place, BATCHED, layers=3), ["structured", "--ratio", "0.4"]),
}
TRAIN = ["--steps", "8", "--batch", "8", "--episodes", "0", "--student-episodes", "0", "--learning-rate", "0.003",
         "--precision", "float32", "--threads", "2"]  # fmt: skip


def run(*words: str) -> None:
    """Run a command of vlatool."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(import_path())}
    subprocess.run([sys.executable, "-m", "vlatool", *words], env=environment, check=True, capture_output=True)


def apart(first: Path, second: Path) -> str:
    """Say how far two results are apart."""
    curves, flat = [], []
    for made in (first, second):
        curves.append(np.array(json.loads((made / "module/training.json").read_text())["losses"]))
        tensors = [load_file(file) for file in sorted((made / "module").glob("*.safetensors"))]
        flat.append(np.concatenate([named[name].ravel() for named in tensors for name in sorted(named)]))
    far = np.linalg.norm(flat[1] - flat[0]) / np.linalg.norm(flat[0])
    return f"losses {np.abs(curves[1] / curves[0] - 1).max():.1e}, weights {far:.1e}"


def main() -> None:
    """Compare."""
    with tempfile.TemporaryDirectory() as made:
        os.environ |= {"VLATOOL_CACHE": f"{made}/cache", "VLATOOL_TRUST": f"{made}/trusted.json"}
        for name in sys.argv[1:] or CASES:
            write, prune = CASES[name]
            place = Path(made, name)
            policy = str(write(place))
            run("prune", *prune, policy, "-o", f"{place}-pruned")
            for way, more in (("one", []), ("two", ["--processes", "2", "--shard"])):
                run("distill", "policy", f"{place}-pruned", "-o", f"{place}-{way}", "--trust", policy, *TRAIN, *more)
            print(f"{name}: {apart(Path(f'{place}-one'), Path(f'{place}-two'))}", flush=True)


if __name__ == "__main__":
    main()
