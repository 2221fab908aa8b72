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
    return difference(np.array(got), wanted[:count]), count


def is_generated(bundle: str) -> bool:
    """Say whether a policy's action is a sequence of tokens, each of which decides what follows."""
    spec = vlatool.load(bundle).spec
    return spec.action.kind == "discrete" and spec.chunk > 1


def of_tokens(bundle: str, folder: Path) -> tuple[float, int]:
    """Return the difference of the first token's logits from those of the float32 bundle beside this one.

    A token that flips changes all that follow, and with random weights a small change flips it: tokens tell nothing
    of a quantized network.
    """
    rows = arrays(folder / "evaluation.npz")
    rows.pop("action")
    policies = [vlatool.load(each, seed=0) for each in (Path(bundle).parent / "float32", Path(bundle))]
    name, found = policies[0].spec.action.name, ([], [])
    for index in range(min(len(next(iter(rows.values()))), ROWS)):
        for policy, logits in zip(policies, found, strict=True):
            given = policy.infer({key: values[index] for key, values in rows.items()})
            logits.append(np.array(given.outputs[name]).reshape(policy.spec.chunk, -1)[0])
    return difference(np.array(found[1]), np.array(found[0])), len(found[0])


def difference(got: np.ndarray, wanted: np.ndarray) -> float:
    """Share of answers that differ, or |difference| / |action|; actions may come without the axis of the chunk."""
    wanted = wanted.reshape(got.shape)
    if np.issubdtype(got.dtype, np.integer):
        return float(np.mean(got != wanted))
    return float(np.linalg.norm(got - wanted) / np.linalg.norm(wanted))


if __name__ == "__main__":
    bundle, folder, engine = sys.argv[1:]
    try:
        generated = Path(bundle).name != "float32" and is_generated(bundle)
        found, count = of_tokens(bundle, Path(folder)) if generated else drift(bundle, Path(folder), engine)
    except VlatoolError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    print(json.dumps({"drift": found, "rows": count}))
