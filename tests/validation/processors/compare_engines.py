"""Bundles on two engines of one machine: how far apart their outputs are, and how long an inference takes on each.

    python tests/validation/processors/compare_engines.py ort_cuda ort_cpu BUNDLE... [--observations 50]

One row of Markdown for each bundle. The engines take turns, observation by observation, on seeded random observations;
the first five inferences of each do not count. The error is the relative L2 distance of all outputs.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import synthetic_observations
from vlatool.errors import VlatoolError
from vlatool.runtime import load

UNCOUNTED = 5
HEAD = "| bundle | {} p50 | {} p50 | error, median | error, largest | golden action off by |\n|---|---|---|---|---|---|"


def row(path: Path, engines: tuple[str, str], observations: int) -> str:
    """Return the row of a bundle; the reason where an engine refuses it."""
    try:
        policies = [load(path, engine=engine, seed=0) for engine in engines]
    except VlatoolError as error:
        return f"| {path.name} | refused: {error.message} |"
    times: list[list[float]] = [[], []]
    errors = []
    for observation in synthetic_observations(Bundle.open(path), observations + UNCOUNTED):
        outputs = []
        for policy, spent in zip(policies, times, strict=True):
            policy.reset(seed=0)
            start = time.perf_counter()
            action = policy.infer(observation)
            spent.append(1e3 * (time.perf_counter() - start))
            outputs.append(np.concatenate([np.ravel(value).astype(float) for value in action.outputs.values()]))
        errors.append(np.linalg.norm(outputs[0] - outputs[1]) / np.linalg.norm(outputs[1]))
    first, second = (float(np.median(spent[UNCOUNTED:])) for spent in times)
    return (
        f"| {path.name} | {first:.2f} ms | {second:.2f} ms | {np.median(errors):.1e} | {max(errors):.1e} "
        f"| {policies[0].golden_error:.1e} |"
    )


def main(arguments: list[str]) -> None:
    """Print a row for each bundle."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("engines", nargs=2)
    parser.add_argument("bundles", nargs="+", type=Path)
    parser.add_argument("--observations", type=int, default=50)
    asked = parser.parse_args(arguments)
    print(HEAD.format(*asked.engines))
    for path in asked.bundles:
        print(row(path, tuple(asked.engines), asked.observations), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
