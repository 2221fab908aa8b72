"""Hold a bundle's actions against those that the original gave on the same observations.

    python _answers.py BUNDLE POLICY_DIR ENGINE

Prints {"drift": ..., "rows": ...}: the relative L2 difference of all actions in physical units; for discrete ones, the
share of answers that differ. Wrong input ends with vlatool's own exit codes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

import vlatool
from vlatool.errors import VlatoolError
from vlatool.runtime import Action, Policy

ROWS = 16


def arrays(file: Path) -> dict[str, np.ndarray]:
    """Name -> array of an .npz file; none when there is no such file."""
    return dict(np.load(file)) if file.exists() else {}


def drift(bundle: str, folder: Path, engine: str) -> tuple[float, int]:
    """Return the difference and the number of observations that it was taken on."""
    rows, noise = arrays(folder / "evaluation.npz"), arrays(folder / "noise.npz")
    wanted, episodes = rows.pop("action"), rows.pop("episode", None)
    policy = vlatool.load(bundle, engine=engine, seed=0)
    count = min(len(wanted), ROWS if episodes is None else len(wanted))
    got = []
    for index in range(count):
        if episodes is not None and index and episodes[index] != episodes[index - 1]:
            policy.reset()
        drawn = {name: values[index] for name, values in noise.items()} or None
        got.append(policy.infer({name: values[index] for name, values in rows.items()}, noise=drawn).chunk)
    return max(difference(np.array(got), wanted[:count]), played(policy, arrays(folder / "played.npz"))), count


def played(policy: Policy, rows: dict[str, np.ndarray]) -> float:
    """Return the difference over an episode of control steps, whose inferences are those of the original."""
    if not rows:
        return 0.0
    wanted, noise = rows.pop("action"), rows.pop("noise")
    given = WithNoise(policy, noise)
    queue, got = vlatool.runtime.ChunkQueue(given), []
    queue.reset()
    for given.step in range(len(wanted)):
        got.append(queue.act({name: values[given.step] for name, values in rows.items()}))
    return difference(np.array(got), wanted)


class WithNoise:
    """A policy that is given the noise of each control step, whatever its program calls it."""

    def __init__(self, policy: Policy, noise: np.ndarray) -> None:
        self.spec, self.observe, self.reset = policy.spec, policy.observe, policy.reset
        (self._name,) = (name for step in policy.program.steps for name in step.noise)
        self._policy, self._noise, self.step = policy, noise, 0

    def infer(self, observation: dict[str, np.ndarray], **_: object) -> Action:
        """Return the next chunk."""
        return self._policy.infer(observation, noise={self._name: self._noise[self.step]})


def difference(got: np.ndarray, wanted: np.ndarray) -> float:
    """Share of answers that differ, or |difference| / |action|; actions may come without the axis of the chunk."""
    wanted = wanted.reshape(got.shape)
    if np.issubdtype(got.dtype, np.integer):
        return float(np.mean(got != wanted))
    return float(np.linalg.norm(got - wanted) / np.linalg.norm(wanted))


if __name__ == "__main__":
    bundle, folder, engine = sys.argv[1:]
    try:
        found, count = drift(bundle, Path(folder), engine)
    except VlatoolError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    print(json.dumps({"drift": found, "rows": count}))
