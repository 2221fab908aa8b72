"""Does a variant lose more episodes than a limit allows? Decided from paired episodes, in as few as suffice.

The baseline and the variant play the same seeds. A pair is *lost* when the baseline alone succeeds and *won* when the
variant alone does; the drop in success rate is ``P(lost) - P(won)``. Two questions are asked at each interim analysis:
does the lower bound of the drop exceed the limit (fail), does its upper bound not (pass)? Neither: more pairs. At the
last one, or where hardly anything that is still to come could decide, it is inconclusive.

**Errors over all interim analyses.** Each side has the error ``alpha``, spent in proportion to the pairs (Lan and
DeMets, Biometrika 70, 1983; the function with exponent 1 of Kim and DeMets, Biometrika 74, 1987). The level of each
analysis follows by the recursion of Armitage, McPherson and Rowe (J. Royal Statistical Society A 132, 1969), each side
alone: that the other one may end the comparison only lowers its error. The bounds are a repeated confidence interval
(Jennison and Turnbull, J. Royal Statistical Society B 51, 1989), which holds whatever made the comparison end.

**Few discordant pairs.** Episodes of policies that are worth compressing agree in most pairs, and normal approximations
err there: with 3 % lost and none won, Tango's score test at these levels would fail 3.4 % instead of 2.5 %. So the
p-value is exact: the chance, in the trinomial distribution of lost, won and neither, of a score statistic (Tango,
Statistics in Medicine 17, 1998) as large as the one seen (Hsueh, Liu and Chen, Biometrics 57, 2001: that chance is
largest where the drop equals the limit). The share of discordant pairs, which is not known, is estimated as the score
statistic does, or is a standard error to either side of that, whichever gives the largest chance: estimation as in
Lloyd and Moldovan (Statistics in Medicine 27, 2008), and some of the maximum of Berger and Boos (J. American
Statistical Association 89, 1994). ``tests/validation/soak/success_trials.py`` adds up both errors exactly.

**What it saves.** Without a drop, two episodes of five and more wherever the largest number would nearly always do: up
to 8 % discordant pairs of 1,000 at a limit of 3 %, 2 % of 3,000 at 1 %. Where even all of them leave every other
comparison open, 30 %, most of it by ending what is hopeless.

**Pairs that begin alike** are worth fewer independent ones (``vlatool.stats.starts``): the counts are reduced to that
number, in favour of neither side.

**What the caller must see to.** Every task has the same share of the pairs at each interim analysis (``plan(tasks=)``
makes that possible), since the drop is one over all tasks; and the pairs of an analysis are all played before it.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlatool.stats.starts import Counts, reduce_counts

Array = NDArray[np.float64]

ALPHA = 0.025
"""Chance of a false verdict over all interim analyses, on either side: a two-sided interval of 95 %."""
ANALYSES = 10
"""Interim analyses, evenly spaced, the last one included."""
FUTILITY = 0.1
"""Chance of a verdict below which no more pairs are played."""
GO_ON = "go on"
_WINDOW = 6.0
"""Standard deviations of the number of discordant pairs, and pairs, beyond which nothing is added up (1e-9)."""
_RESOLUTION = 1e-5
"""Of the bounds, a share."""
_GRID = 801
"""Places at which the density of a sum is kept, odd for Simpson's rule."""


@dataclass(frozen=True)
class Decision:
    """Decision from the pairs.

    Args:
        verdict: ``pass``, ``fail``, ``inconclusive`` or, while more pairs may decide, ``go on``.
        drop: Seen, a share; positive is worse than the baseline. One that ended a comparison early tends to overstate.
        low, high: Bounds of the drop, each with confidence ``1 - alpha`` over all interim analyses.
        limit: The largest drop that passes, a share.
        lost, won, pairs: Observed counts.
        most: Pairs that would have been played without interim analyses.
    """

    verdict: str
    drop: float
    low: float
    high: float
    limit: float
    lost: int
    won: int
    pairs: int
    most: int

    @property
    def over(self) -> bool:
        """Whether no more pairs are to be played."""
        return self.verdict != GO_ON


@dataclass(frozen=True)
class Plan:
    """When a comparison is looked at, and by which levels; ``plan`` makes one.

    Args:
        limit: The largest drop that passes, a share.
        interim_analyses: After how many pairs, ascending.
        alpha: Chance of a false verdict over all of them, on either side.
        futile: Chance of a verdict below which the comparison ends as inconclusive; 0 plays all pairs.
    """

    limit: float
    interim_analyses: tuple[int, ...]
    alpha: float = ALPHA
    futile: float = FUTILITY

    def __post_init__(self) -> None:
        """Refuse what decides nothing.

        Raises:
            ValueError: when there is no limit to hold, no error to spend, or the interim analyses do not ascend.
        """
        if not 0 <= self.limit < 1:
            raise ValueError(f"the limit is {self.limit}; allowed: a share from 0 and below 1")
        if not 0 < self.alpha < 0.5:
            raise ValueError(f"alpha is {self.alpha}; allowed: above 0 and below 0.5")
        if not 0 <= self.futile < 1:
            raise ValueError(f"the chance that is futile is {self.futile}; allowed: from 0 and below 1")
        after = self.interim_analyses
        if not after or list(after) != sorted(set(after)) or after[0] < 1:
            raise ValueError(f"the interim analyses are {after}; allowed: ascending numbers from 1")

    @property
    def most(self) -> int:
        """Pairs of the last interim analysis."""
        return self.interim_analyses[-1]

    @property
    def levels(self) -> tuple[float, ...]:
        """Error of each interim analysis alone, on either side."""
        return spending_levels(tuple(after / self.most for after in self.interim_analyses), self.alpha)

    def verdict(self, lost: int, won: int, pairs: int, size: int | None = None) -> str:
        """Return ``pass``, ``fail``, ``inconclusive`` or ``go on``, without the interval; see ``judge``.

        Raises:
            ValueError: when no interim analysis has so many pairs, or the counts are invalid.
        """
        level = self._level(lost, won, pairs)
        least, largest = reduce_counts(lost, won, pairs, size or pairs)
        if _drop(least) > self.limit and exact_p(*least, self.limit) <= level:
            return "fail"
        if _drop(largest) < self.limit and exact_p(*_swap(largest), -self.limit) <= level:
            return "pass"
        return "inconclusive" if pairs == self.most or self._futile(lost, won, pairs) else GO_ON

    def judge(self, lost: int, won: int, pairs: int, size: int | None = None) -> Decision:
        """Judge the pairs of an interim analysis.

        Args:
            lost: Pairs, of all so far, in which the baseline alone succeeded.
            won: Pairs in which the variant alone succeeded.
            pairs: All of them.
            size: Independent pairs that they are worth (``starts.independent``); all of them when None.

        Raises:
            ValueError: when no interim analysis has so many pairs, or the counts are invalid.

        Example:
            >>> comparison = plan(limit=0.03, most=1000)
            >>> comparison.judge(lost=3, won=2, pairs=200).verdict
            'go on'
            >>> found = comparison.judge(lost=2, won=1, pairs=300)
            >>> found.verdict, round(found.low, 3), round(found.high, 3)
            ('pass', -0.02, 0.029)
        """
        verdict = self.verdict(lost, won, pairs, size)
        return Decision(verdict, *self.interval(lost, won, pairs, size), self.limit, lost, won, pairs, self.most)

    def interval(self, lost: int, won: int, pairs: int, size: int | None = None) -> tuple[float, float, float]:
        """Return the drop with its repeated confidence interval, as ``intervals.paired_drop`` does for a fixed number.

        Over all interim analyses together, each bound is wrong with chance ``alpha`` at most, so it may be reported
        wherever the comparison ended. It agrees with the verdict: above the limit is fail, not above it is pass.

        Raises:
            ValueError: when no interim analysis has so many pairs, or the counts are invalid.
        """
        level = self._level(lost, won, pairs)
        least, largest = reduce_counts(lost, won, pairs, size or pairs)
        high = -_lower_bound(*_swap(largest), level, -self.limit)
        return (lost - won) / pairs, _lower_bound(*least, level, self.limit), high

    def _level(self, lost: int, won: int, pairs: int) -> float:
        if pairs not in self.interim_analyses:
            raise ValueError(f"{pairs} pairs; the interim analyses are after {self.interim_analyses}")
        if lost < 0 or won < 0 or lost + won > pairs:
            raise ValueError(f"{lost} lost and {won} won of {pairs} pairs")
        return self.levels[self.interim_analyses.index(pairs)]

    def _futile(self, lost: int, won: int, pairs: int) -> bool:
        """Whether a later analysis decides with a chance below ``futile``, even one standard error to the better side.

        The chance is that of a normal sum with this drift, added up over later analyses. A verdict is never made of it,
        so both errors can only fall by it (Jennison and Turnbull, Group Sequential Methods, 2000, section 10).
        """
        from scipy.special import ndtr, ndtri

        now = pairs / self.most
        later = np.array([after / self.most for after in self.interim_analyses if after > pairs])
        bounds = -ndtri(np.array(self.levels[-len(later) :])) * np.sqrt(later)
        score = float(_score(lost, won, pairs, self.limit))
        for side in (score, -score):
            drift = (side + 1) / math.sqrt(now)
            reached = side * math.sqrt(now) + max(0.0, drift) * (later - now)
            if ndtr((reached - bounds) / np.sqrt(later - now)).sum() >= self.futile:
                return False
        return True


def plan(
    limit: float, most: int, alpha: float = ALPHA, tasks: int = 1, analyses: int = ANALYSES, futile: float = FUTILITY
) -> Plan:
    """Return a plan with evenly spaced interim analyses.

    Args:
        limit: The largest drop that passes, a share from 0.
        most: Pairs to play at most; rounded up to a multiple of the tasks.
        alpha: Chance of a false verdict over all interim analyses, on either side.
        tasks: Each analysis has equally many pairs of each.
        analyses: Number of analyses, the last one included; fewer where there are not as many pairs of each task.
        futile: Chance of a verdict below which the comparison ends as inconclusive; 0 plays all pairs.

    Raises:
        ValueError: when one of them is invalid.

    Example:
        >>> plan(limit=0.01, most=500, tasks=8, analyses=4).interim_analyses
        (128, 256, 384, 504)
    """
    if most < 1 or tasks < 1 or analyses < 1:
        raise ValueError(f"{most} pairs, {tasks} tasks, {analyses} interim analyses; allowed: from 1")
    rounds = -(-most // tasks)
    after = {tasks * -(-rounds * number // analyses) for number in range(1, analyses + 1)}
    return Plan(limit, tuple(sorted(after)), alpha, futile)


@functools.lru_cache(maxsize=64)
def spending_levels(times: tuple[float, ...], alpha: float) -> tuple[float, ...]:
    """Return the one-sided level of each interim analysis that together spend ``alpha`` in proportion to time.

    The density of the sum of what has not crossed a bound yet is carried from analysis to analysis (Armitage, McPherson
    and Rowe 1969; Jennison and Turnbull 2000, section 19); each bound is where the error due at its time is spent.

    Args:
        times: Shares of the pairs, ascending to 1.
        alpha: Error over all of them.

    Example:
        >>> [round(level, 4) for level in spent_in_turns((0.5, 1.0), 0.025)]
        [0.0125, 0.0168]
    """
    from scipy.special import ndtr

    grid, mass, before = np.zeros(1), np.ones(1), 0.0  # of the sum of increments, whose variance is the time
    levels = []
    for time in times:
        step = time - before
        low, high = -8 * math.sqrt(time), 12 * math.sqrt(time)
        reached = low
        while high - reached > 1e-10:
            middle = (reached + high) / 2
            if float(mass @ ndtr((grid - middle) / math.sqrt(step))) > alpha * step:
                reached = middle
            else:
                high = middle
        levels.append(float(ndtr(-high / math.sqrt(time))))
        further = np.linspace(low, high, _GRID)
        density = np.exp(-((further[:, None] - grid) ** 2) / (2 * step)) @ mass / math.sqrt(2 * math.pi * step)
        weights = np.ones(_GRID)
        weights[1:-1:2], weights[2:-1:2] = 4, 2
        grid, mass, before = further, density * weights * (further[1] - further[0]) / 3, time
    return tuple(levels)


def exact_p(lost: int, won: int, pairs: int, drop: float) -> float:
    """Return the chance of a score statistic as large as this one when the true drop is ``drop``, or smaller.

    See the head of the module. That of one as small is ``exact_p(won, lost, pairs, -drop)``.

    Args:
        lost, won, pairs: Observed counts.
        drop: A share above -1 and below 1.

    Example:
        >>> round(exact_p(5, 0, 100, 0.0), 3)
        0.012
    """
    from scipy.special import bdtrc, gammaln, xlog1py, xlogy

    rate = math.sqrt(2 * float(_restricted_estimate(lost, won, pairs, drop)) + drop)
    away = 0.5 / math.sqrt(pairs)  # a standard error of the root of a share
    least = max(abs(drop), 1e-9)
    rates = np.clip(np.array([max(0.0, rate - away), rate, rate + away]) ** 2, least, 1)[:, None]
    spread = _WINDOW * np.sqrt(pairs * rates * (1 - rates)) + _WINDOW
    first = max(0, math.floor(float((pairs * rates - spread).min())))
    last = min(pairs, math.ceil(float((pairs * rates + spread).max())))
    discordant = np.arange(first, last + 1)
    ways = gammaln(pairs + 1) - gammaln(discordant + 1) - gammaln(pairs - discordant + 1)
    chances = np.exp(ways + xlogy(discordant, rates) + xlog1py(pairs - discordant, -rates))
    lose = np.clip((rates + drop) / (2 * rates), 0, 1)  # share of the discordant pairs that are lost
    beyond = bdtrc(_min_lost(lost, won, pairs, drop, discordant) - 1, discordant, lose)
    return min(1.0, float((chances * beyond).sum(axis=1).max()))


def _min_lost(lost: int, won: int, pairs: int, drop: float, discordant: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each number of discordant pairs, how many must be lost for a score as large as the one seen.

    One more than there are, where it is never as large. The score grows with each pair that is lost instead of won.
    """
    seen = float(_score(lost, won, pairs, drop)) - 1e-9
    below, reached = np.full_like(discordant, -1), discordant + 1
    for _ in range(int(reached[-1] + 1).bit_length()):
        middle = np.maximum((below + reached) // 2, 0)
        enough = _score(middle, discordant - middle, pairs, drop) >= seen
        below, reached = np.where(enough, below, middle), np.where(enough, middle, reached)
    return reached


def _score(lost: int | NDArray[np.int64], won: int | NDArray[np.int64], pairs: int, drop: float) -> Array:
    """Return Tango's score statistic (1998): the drop seen less ``drop``, by its standard error if that were true."""
    variance = pairs * (2 * _restricted_estimate(lost, won, pairs, drop) + drop * (1 - drop))
    return np.asarray((lost - won - pairs * drop) / np.sqrt(np.maximum(variance, 1e-12)))


def _restricted_estimate(lost: int | NDArray[np.int64], won: int | NDArray[np.int64], pairs: int, drop: float) -> Array:
    """Return the maximum likelihood estimate of the chance to win when the true drop is ``drop`` (Tango 1998)."""
    linear = (2 * pairs - lost + won) * drop - (lost + won)
    root = np.sqrt(np.maximum(linear * linear + 8 * pairs * won * drop * (1 - drop), 0.0))
    return np.asarray(np.maximum((root - linear) / (4 * pairs), max(0.0, -drop)))


@functools.lru_cache(maxsize=256)
def _lower_bound(lost: int, won: int, pairs: int, level: float, limit: float) -> float:
    """Return what the drop exceeds with confidence ``1 - level``: the test is turned round, by bisection.

    It starts from the limit, so that the bound lies on the side of it on which the verdict is.
    """

    def ruled_out(drop: float) -> bool:
        return exact_p(lost, won, pairs, drop) <= level

    below, above = -1.0, (lost - won) / pairs
    if below < limit < above:
        below, above = (limit, above) if ruled_out(limit) else (below, limit)
    step = math.sqrt(lost + won + 1) / pairs
    while above - step > below:
        if ruled_out(above - step):
            below = above - step
        else:
            above, step = above - step, 2 * step
    while above - below > _RESOLUTION:
        middle = (below + above) / 2
        below, above = (middle, above) if ruled_out(middle) else (below, middle)
    return (below + above) / 2


def _drop(counts: Counts) -> float:
    lost, won, pairs = counts
    return (lost - won) / pairs


def _swap(counts: Counts) -> Counts:
    lost, won, pairs = counts
    return won, lost, pairs


def exact_drop(
    lost: int, won: int, pairs: int, confidence: float = 0.95, size: int | None = None
) -> tuple[float, float, float]:
    """Return the drop of a fixed number of pairs, with an interval whose bounds err no more often than they say.

    ``intervals.paired_drop`` is quicker, and near nominal on both sides together; on one side it errs up to five times
    as often as it says where hardly any pair is discordant.

    Args:
        lost, won, pairs: Counts; pairs from 1.
        size: Independent pairs that they are worth (``starts.independent``); all of them when None.

    Example:
        >>> [round(bound, 2) for bound in exact_drop(0, 0, 300)]
        [0.0, -0.01, 0.01]
        >>> [round(bound, 2) for bound in exact_drop(0, 0, 300, size=3)]
        [0.0, -0.71, 0.71]
    """
    return plan(0.0, pairs, alpha=(1 - confidence) / 2, analyses=1).interval(lost, won, pairs, size)
