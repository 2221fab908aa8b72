"""Outputs that no robot may execute: none reaches the controller, from a graph or from a policy of another package.

    python tests/validation/stack/bad_outputs.py --outputs 100000

Chunks with NaN or infinity at random places, of wrong shapes and dtypes, and things that are no arrays, a seventh of
them right; and a graph whose output is not finite wherever its input says so.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "runtime"))
from _numbered import NumberedPolicy, spec_of
from _written import written

from vlatool.bundle.spec import TensorSpec
from vlatool.runtime import Policy
from vlatool.runtime.interface import POLICY, Action
from vlatool.runtime.stack import Fallback, build_stack

ACTION = TensorSpec("a", (1, 4, 3), labels=("x", "y", "gripper"), mode="absolute")
EXTREMES = (np.nan, np.inf, -np.inf)
WRONG = (
    lambda chunk: chunk[:-1], lambda chunk: chunk[:, :-1], lambda chunk: chunk[None], lambda chunk: chunk[0],
    lambda chunk: np.concatenate([chunk, chunk]), lambda chunk: chunk.astype(np.float64),
    lambda chunk: chunk.astype(np.float16), lambda chunk: chunk.astype(np.int64), lambda chunk: chunk.astype(object),
    lambda chunk: chunk.tolist(), lambda chunk: None, lambda chunk: chunk.astype(str),
    lambda chunk: chunk.astype(complex), lambda chunk: np.empty((0, 3), np.float32),
    lambda chunk: np.ma.masked_array(chunk), lambda chunk: float(chunk[0, 0]),
)  # fmt: skip


class WrongPolicy(NumberedPolicy):
    """Gives a right chunk at every seventh step, with 7 in each place, and anything else between."""

    def __init__(self, seed: int) -> None:
        super().__init__(spec_of(4, 1, ACTION))
        self.random = np.random.default_rng(seed)
        self.kinds = Counter[str]()

    def infer(self, observation: Any, *, noise: Any = None) -> Action:
        """Return a chunk."""
        chunk: Any = np.full((4, 3), 7, np.float32)
        if observation["t"] % 7:
            chunk[:] = 8
            kind = self.random.integers(2 * len(WRONG))
            if kind < len(WRONG):
                chunk = WRONG[kind](chunk)
            else:
                chunk[self.random.integers(4), self.random.integers(3)] = EXTREMES[kind % 3]
            self.kinds[str(kind if kind < len(WRONG) else "not finite")] += 1
        return Action(chunk, ACTION.labels, 0.0, 0, {})


def wrong_outputs(outputs: int, seed: int = 0) -> dict[str, int]:
    """Return how many wrong outputs there were, and how many reached the robot."""
    policy = WrongPolicy(seed)
    options = Fallback(misses=10**9, window=10**9, hold_s=1e9)
    stack = build_stack(policy, fallback=options)
    reached = 0
    for step in range(outputs):
        action = stack.act({"t": step})
        reached += not (type(action) is np.ndarray and action.dtype == np.float32 and action.tolist() == [7, 7, 7])
        reached += stack.origin.source == POLICY and step % 7 != 0
    return {"wrong": sum(policy.kinds.values()), "kinds": len(policy.kinds), "reached the robot": reached}


def graph_outputs(outputs: int, seed: int = 0) -> dict[str, int]:
    """Return the same of a graph that divides by an input, which is 0 at most steps."""
    x, zero = TensorSpec("x", (1, 2)), TensorSpec("d", (1, 2))
    text = "g (float[1,2] x, float[1,2] d) => (float[1,2] y) { y = Div(x, d) }"
    random, reached, wrong = np.random.default_rng(seed), 0, 0
    with tempfile.TemporaryDirectory() as folder:
        policy = Policy.open(written(Path(folder) / "bundle", text, (x, zero)), threads=1)
        stack = build_stack(policy, fallback=Fallback(misses=10**9, window=10**9, hold_s=1e9, start=[1, 1]))
        for _ in range(outputs):
            divisor = np.ones(2, np.float32)
            bad = random.random() < 0.8
            divisor[random.integers(2)] = 0 if bad else 1
            wrong += bad
            action = stack.act({"x": random.integers(0, 2, 2).astype(np.float32), "d": divisor})
            reached += not np.isfinite(action).all() or (bad and stack.origin.source == POLICY)
    return {"wrong": wrong, "reached the robot": reached}


def main() -> None:
    """Print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--outputs", type=int, default=100_000)
    outputs = parser.parse_args().outputs
    for title, found in (("of a policy", wrong_outputs(outputs)), ("of a graph", graph_outputs(outputs))):
        print(f"{title}: {found}")
        if found["reached the robot"]:
            sys.exit(1)


if __name__ == "__main__":
    main()
