"""Temporal ensembling here and in LeRobot, on the same chunks: the largest difference of their actions.

python tests/validation/foreign/temporal_ensembles.py --python PYTHON_WITH_LEROBOT
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime.control.temporal_ensemble import TemporalEnsemble
from vlatool.runtime.interface import Action

COEFFICIENTS = (0.01, 0.0, 0.5, -0.1, 3.0)
SIZES = ((1, 3), (2, 1), (8, 7), (100, 14))
"""Actions of a chunk, elements of an action."""
STEPS = 250
LEROBOT = """
import sys
import numpy as np
import torch
from lerobot.policies.act.modeling_act import ACTTemporalEnsembler

cases, answers = np.load(sys.argv[1]), {}
for name in cases.files:
    chunks = torch.from_numpy(cases[name])
    ensemble = ACTTemporalEnsembler(float(name.split()[0]), chunks.shape[1])
    answers[name] = np.stack([ensemble.update(chunk[None].clone())[0].numpy() for chunk in chunks])
np.savez(sys.argv[2], **answers)
"""


class Given:
    """A policy that infers chunks (N, T, A), one after the other."""

    def __init__(self, chunks: NDArray[Any]) -> None:
        _, length, width = chunks.shape
        action = TensorSpec("action", (1, length, width), mode="absolute")
        self.spec = PolicySpec((TensorSpec("t", (1, 1)),), (action,), 20, length)
        self._chunks: Iterator[NDArray[Any]] = iter(chunks)

    def infer(self, observation: Any, *, noise: Any = None) -> Action:
        """Return the next chunk."""
        return Action(next(self._chunks), (), 0.0, 0, {})

    def reset(self, seed: int | None = None) -> None:
        """Go on."""


def cases() -> dict[str, NDArray[Any]]:
    """Return the chunks of each case, (N, T, A) float32; its name begins with the coefficient."""
    random = np.random.default_rng(5)
    return {
        f"{coefficient} {length} {width}": random.standard_normal((STEPS, length, width), np.float32) * 100
        for coefficient in COEFFICIENTS
        for length, width in SIZES
    }


def ours(chunks: NDArray[Any], coefficient: float) -> NDArray[Any]:
    """Return the actions of ``TemporalEnsemble``, (N, A)."""
    ensemble = TemporalEnsemble(Given(chunks), coefficient=coefficient)
    return np.stack([ensemble.act({}) for _ in chunks])


def main() -> None:
    """Print the largest difference of each case; 100 is the scale of the actions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", required=True, help="Python with LeRobot")
    options = parser.parse_args()
    given = cases()
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder, name)) for name in ("chunks.npz", "actions.npz")]
        np.savez(files[0], **given)
        subprocess.run([options.python, "-c", LEROBOT, *files], check=True)
        with np.load(files[1]) as theirs:
            for name, chunks in given.items():
                difference = np.abs(ours(chunks, float(name.split()[0])) - theirs[name]).max()
                print(f"coefficient, chunk, elements {name}: {difference:.2g} of 100 in {STEPS} steps")


if __name__ == "__main__":
    main()
