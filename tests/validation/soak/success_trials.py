"""Add up exactly what the group-sequential test of success rates decides, how often it errs and what it saves.

    python tests/validation/soak/success_trials.py
    python tests/validation/soak/success_trials.py --limits 0.01 0.05 --most 300 --alpha 0.01
    python tests/validation/soak/success_trials.py --discordant 0.3 0.5 --limits 0.03 --most 500

The distribution of lost and won pairs is carried from one interim analysis to the next, without what has been decided:
trinomial chances, no draws. The first table has the true drop on the limit, where both errors are largest; the second
one has no drop at all. A line takes seconds to a minute.
"""

from __future__ import annotations

import argparse
import functools
import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.special import gammaln, xlog1py, xlogy

from vlatool.stats.success_sequential import ALPHA, Plan, plan

Array = NDArray[np.float64]
LEAST = 1e-9
"""Chance of a cell below which it is left out."""


def increments(pairs: int, lose: float, win: float) -> Array:
    """Return the chances of lost (rows) and won (columns) in so many further pairs."""
    lost, won = (np.arange(min(pairs, int(pairs * p + 8 * math.sqrt(pairs * p) + 12)) + 1) for p in (lose, win))
    rest = pairs - lost[:, None] - won
    ways = gammaln(pairs + 1) - gammaln(lost + 1)[:, None] - gammaln(won + 1) - gammaln(np.maximum(rest, 0) + 1)
    logs = ways + xlogy(lost, lose)[:, None] + xlogy(won, win) + xlog1py(np.maximum(rest, 0), -lose - win)
    return np.where(rest >= 0, np.exp(logs), 0)


@functools.cache
def verdict(comparison: Plan, lost: int, won: int, pairs: int) -> str:
    """Return the verdict, once for each cell."""
    return comparison.verdict(lost, won, pairs)


def added_up(comparison: Plan, lose: float, win: float) -> tuple[Counter[str], float]:
    """Return the chance of each verdict, and the mean number of pairs."""
    chances, found, played, before = np.ones((1, 1)), Counter[str](), 0.0, 0
    for pairs in comparison.interim_analyses:
        played += float(chances.sum()) * (pairs - before)
        chances = np.maximum(fftconvolve(chances, increments(pairs - before, lose, win)), 0)
        for lost, won in np.argwhere(chances > LEAST).tolist():
            said = verdict(comparison, lost, won, pairs)
            if said != "go on":
                found[said] += float(chances[lost, won])
                chances[lost, won] = 0
        chances[chances <= LEAST] = 0
        before = pairs
    return found, played


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limits", type=float, nargs="+", default=[0.01, 0.03])
    parser.add_argument("--most", type=int, nargs="+", default=[1000])
    parser.add_argument("--alpha", type=float, default=ALPHA, help="on either side")
    parser.add_argument("--discordant", type=float, nargs="+", default=[0.01, 0.02, 0.04, 0.06, 0.08, 0.1])
    given = parser.parse_args()
    for limit in given.limits:
        for most in given.most:
            tables(plan(limit, most, given.alpha), sorted({limit, *given.discordant}))


def tables(comparison: Plan, discordant: list[float]) -> None:
    """Print the errors on the limit, and what is saved without a drop."""
    print(
        f"\nlimit {comparison.limit:.1%}, at most {comparison.most} pairs, alpha {comparison.alpha:.1%} on either side"
    )
    print("  drop discordant     fail     pass inconclusive  pairs  saved")
    for drop in sorted({comparison.limit, 0.0}, reverse=True):
        for share in discordant:
            if share < drop or not share:
                continue
            found, played = added_up(comparison, (share + drop) / 2, (share - drop) / 2)
            cells = f"{found['fail']:8.2%} {found['pass']:8.2%} {found['inconclusive']:12.2%}"
            print(f"{drop:6.1%} {share:10.1%} {cells} {played:6.0f} {1 - played / comparison.most:6.0%}", flush=True)


if __name__ == "__main__":
    main()
