"""Is B slower than A by more than a margin? Decided from processes that each time both, in as few as suffice.

Each process gives one log ratio. Two questions are asked of their Hodges-Lehmann centre at each interim analysis: does
its lower bound exceed the margin (then the candidate is slower: fail), does its upper bound stay below it (pass)?
Neither: more processes. The error probability is shared out over the interim analyses (Bonferroni), and the bounds are
those of the exact signed-rank distribution, so the stated error holds for any symmetric noise however few processes
there are.

Several statistics of the same processes (``judge_jointly``) fail when one of them does and pass when all do. Between
equal bundles each is symmetric, whatever it is: swapping the two turns its sign.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vlatool.stats.outcome import Outcome
from vlatool.stats.signed_rank import hodges_lehmann, lower_bound, min_differences, upper_bound

INTERIM_ANALYSES = (10, 20, 40)
ALPHA = 0.01
"""Chance of a false verdict over all interim analyses, on either side."""
POWER = 0.95
DRAWS = 1000


@dataclass(frozen=True)
class Decision:
    """Decision from the processes.

    Args:
        verdict: pass, fail or inconclusive.
        ratio: Candidate over baseline, Hodges-Lehmann centre; 1.1 is a tenth slower.
        low, high: Bounds of the ratio, each at the error of one analysis.
        margin: The largest slowdown that passes, a share.
        processes: Number of measured processes.
        spread: Standard deviation of the log ratios of single processes.
        alpha: Chance of a false verdict of the analysis, on either side.
    """

    verdict: Outcome
    ratio: float
    low: float
    high: float
    margin: float
    processes: int
    spread: float
    alpha: float = ALPHA / 3

    @property
    def detectable(self) -> float:
        """Slowdown, a share, that as many processes with this spread would fail with a chance of ``POWER``."""
        return math.exp(math.log1p(self.margin) + reach(self.processes, self.alpha) * self.spread) - 1

    @property
    def processes_needed(self) -> int:
        """Processes, all in all, that would decide if the centre is where it seems to be; 0 when it is decided.

        None would do where the centre lies on the margin: then it is a million.
        """
        if self.verdict != Outcome.INCONCLUSIVE:
            return 0
        gap = abs(math.log(self.ratio) - math.log1p(self.margin))
        needed = reach(self.processes, self.alpha) * self.spread
        most = 1_000_000
        if not gap or not needed < gap * math.sqrt(most):
            return most
        return min(most, max(self.processes + 1, math.ceil(self.processes * (needed / gap) ** 2)))


@functools.lru_cache(maxsize=32)
def reach(processes: int, alpha: float) -> float:
    """Return how many standard deviations of one process beyond the margin a slowdown is found with ``POWER``.

    A shift of all differences shifts the bound alike, so it is a quantile of the bound on normal noise: of ``DRAWS``
    draws, seeded. The spread is taken as known.
    """
    if processes < min_differences(alpha):
        return math.inf
    noise = np.random.default_rng(0).normal(size=(DRAWS, processes))
    return float(np.quantile([-lower_bound(sample, alpha) for sample in noise], POWER))


def judge(
    log_ratios: Sequence[float], margin: float, alpha: float = ALPHA / len(INTERIM_ANALYSES), sharing: int = 1
) -> Decision:
    """Judge the processes that there are.

    Args:
        log_ratios: Natural logarithm of candidate over baseline of each process.
        margin: The largest slowdown that passes, a share above -1.
        alpha: Chance of a false verdict of this analysis, on either side.
        sharing: Statistics of which one alone makes a gate fail, while all of them must pass: they share the error of a
            failure, and each may keep that of a pass.

    Raises:
        ValueError: when there is no ratio or one is not finite, or the margin is invalid.
    """
    if not margin > -1:
        raise ValueError(f"the margin is {margin}; allowed: above -1")
    low, high = lower_bound(log_ratios, alpha / sharing), upper_bound(log_ratios, alpha)
    limit = math.log1p(margin)
    passes = Outcome.PASS if high < limit else Outcome.INCONCLUSIVE
    verdict = Outcome.FAIL if low > limit else passes
    count = len(log_ratios)
    spread = float(np.std(log_ratios, ddof=1)) if count > 1 else math.nan
    centre = hodges_lehmann(log_ratios)
    return Decision(verdict, math.exp(centre), math.exp(low), math.exp(high), margin, count, spread, alpha / sharing)


def judge_jointly(
    measure: Callable[[int], Sequence[float]],
    statistics: int,
    margin: float,
    interim_analyses: Sequence[int] = INTERIM_ANALYSES,
    alpha: float = ALPHA,
) -> tuple[list[Decision], list[Sequence[float]]]:
    """Measure process after process until a look decides or the last one is over: one statistic fails, or all pass.

    Args:
        measure: Called with the number of the process, from 0; returns a log ratio for each statistic.
        margin: The largest slowdown that passes, a share.
        interim_analyses: After how many processes they are judged, ascending.
        alpha: Chance of a false verdict over all interim analyses, on either side.

    Returns:
        A decision for each statistic, and the log ratios of every process.

    Raises:
        ValueError: when the interim analyses do not ascend, or the first is too early to decide anything.
    """
    after = tuple(interim_analyses)
    least = min_differences(alpha / statistics / len(after)) if after else 1
    if not after or list(after) != sorted(set(after)) or after[0] < least:
        raise ValueError(f"the interim analyses are {after}; allowed: ascending numbers from {least}")
    processes: list[Sequence[float]] = []
    for count in after:
        while len(processes) < count:
            processes.append(measure(len(processes)))
        decisions = [judge(ratios, margin, alpha / len(after), statistics) for ratios in zip(*processes, strict=True)]
        verdicts = {decision.verdict for decision in decisions}
        if Outcome.FAIL in verdicts or Outcome.INCONCLUSIVE not in verdicts:
            break
    return decisions, processes
