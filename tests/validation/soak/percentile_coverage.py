"""How often the upper bound of a percentile holds, on made-up latencies whose true percentiles are known.

    python tests/validation/soak/percentile_coverage.py [--runs 10000]

Prints, for each shape of distribution and percentile, the share of runs whose bound is not below the truth; the bound
claims 99 %. A series that is too short for a percentile has no bound and does not count.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from statistics import NormalDist

import numpy as np

from vlatool.stats.percentiles import CONFIDENCE, percentile

Array = np.ndarray
Shape = tuple[Callable[[np.random.Generator, int], Array], Callable[[float], float]]
SPREAD, TAIL, SLOW = 0.3, 1.5, 0.07
LENGTHS = {50.0: 200, 90.0: 800, 99.0: 4000}
"""Percentile -> calls of a run."""


def normal(share: float) -> float:
    """Return a percentile of the standard normal distribution."""
    return NormalDist().inv_cdf(share)


def following(random: np.random.Generator, count: int, follow: float) -> Array:
    """Return a first-order autoregression with standard normal values."""
    shocks = random.normal(size=count) * math.sqrt(1 - follow**2)
    found = np.empty(count)
    value = random.normal()
    for place in range(count):
        value = found[place] = follow * value + shocks[place]
    return found


def two_humped(share: float) -> float:
    """Return a percentile of the bimodal distribution, by bisection."""
    low, high = 0.0, 10.0
    for _ in range(80):
        middle = (low + high) / 2
        below = (1 - SLOW) * NormalDist(1, 0.05).cdf(middle) + SLOW * NormalDist(3, 0.05).cdf(middle)
        low, high = (middle, high) if below < share else (low, middle)
    return high


SHAPES: dict[str, Shape] = {
    "log-normal": (
        lambda random, count: np.exp(SPREAD * random.normal(size=count)),
        lambda share: math.exp(SPREAD * normal(share)),
    ),
    "Pareto": (lambda random, count: 1 + random.pareto(TAIL, size=count), lambda share: (1 - share) ** (-1 / TAIL)),
    "bimodal": (
        lambda random, count: np.where(random.random(count) < SLOW, 3.0, 1.0) + 0.05 * random.normal(size=count),
        two_humped,
    ),
    **{
        f"AR(1) {follow}": (
            lambda random, count, follow=follow: np.exp(SPREAD * following(random, count, follow)),
            lambda share: math.exp(SPREAD * normal(share)),
        )
        for follow in (0.3, 0.7)
    },
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    runs = parser.parse_args().runs
    print(f"| {runs:,} runs, bounds at {CONFIDENCE:.0%} | " + " | ".join(f"p{each:g}" for each in LENGTHS) + " |")
    print("|---|" + "---|" * len(LENGTHS))
    for name, (make, truth) in SHAPES.items():
        cells = []
        for percent, count in LENGTHS.items():
            random = np.random.default_rng(0)
            found = [percentile(make(random, count), percent) for _ in range(runs)]
            known = [each.bound >= truth(percent / 100) for each in found if each.known]
            cells.append(f"{np.mean(known):.2%} of {len(known):,} (n = {count})")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
