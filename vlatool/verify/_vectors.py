"""Explanations of vectors of a log: each element as a straight line of an element of the reference, some steps before.

Elements are assigned to each other so that the sum of what correlations leave unexplained is smallest (the assignment
problem, ``scipy.optimize.linear_sum_assignment``); a line is then taken for the simplest known change that fits it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlatool.files.printable import amount
from vlatool.runtime.statistics import Normaliser
from vlatool.verify._explanation import Explanation
from vlatool.verify._pairing import Pairs

Array = NDArray[np.float64]
FACTORS = {
    180 / math.pi: "degrees instead of radians", math.pi / 180: "radians instead of degrees",
    1000.0: "mm instead of m", 0.001: "m instead of mm", 100.0: "cm or percent instead of m or a share",
    0.01: "m or a share instead of cm or percent", 255.0: "0-255 instead of 0-1", 1 / 255: "0-1 instead of 0-255",
}  # fmt: skip
MAX_UNLIKE = 0.5
"""Share of a signal's spread that correlation may leave and the two still be of the same moment."""
BETTER = 0.6
"""Share of the error that a more complex explanation may leave and still be preferred."""
NOISE = 0.03
"""Share of a signal's spread that a sensor's noise may be, beyond what a straight line leaves."""
COST_ORDER, COST_DELAY = 0.04, 0.03
"""What an explanation by another order, or by a delay, costs in terms of unexplained spread."""


@dataclass(frozen=True)
class Match:
    """How elements of a log are assigned to those of the reference.

    Args:
        order: element of the reference for each element of the log; its own where nothing can be said.
        delay: control steps by which the log is late.
        cost: mean unexplained share of the spread, 0-1.
        own: the same without another order or a delay.
    """

    order: tuple[int, ...]
    delay: int
    cost: float
    own: float


def match_vectors(log: Array, reference: Array, pairings: Mapping[int, Pairs]) -> Match | None:
    """Return the best match of two signals (N, A) and (M, A); None when all elements are constant."""
    if 0 not in pairings:
        return None
    own = _assigned(log, reference, pairings[0], same_order=True)
    if own is None:
        return None
    found = [(own[1], Match(own[0], 0, own[1], own[1]))]
    for delay, pairs in pairings.items():
        for same_order in (True, False):
            result = _assigned(log, reference, pairs, same_order=same_order)
            if result is None or (same_order and not delay):
                continue
            moved = result[0] != own[0]
            price = result[1] + COST_ORDER * moved + COST_DELAY * (abs(delay) > 0) + 0.001 * abs(delay)
            found.append((price, Match(*result[:1], delay, result[1], own[1])))
    price, best = min(found, key=lambda each: each[0])
    return best if price < BETTER * own[1] else found[0][1]


def _assigned(log: Array, reference: Array, pairs: Pairs, *, same_order: bool) -> tuple[tuple[int, ...], float] | None:
    """Return the element of the reference for each of the log, and the mean share that is left unexplained."""
    from scipy.optimize import linear_sum_assignment

    left = unexplained_share(log[pairs.log], reference[pairs.reference])
    rows = np.flatnonzero(np.isfinite(left).any(axis=1))
    columns = np.flatnonzero(np.isfinite(left).any(axis=0))
    if same_order:
        both = np.intersect1d(rows, columns)
        mine, theirs = both, both
    else:
        mine, theirs = (part[where] for part, where in zip(
            (rows, columns), linear_sum_assignment(left[np.ix_(rows, columns)]), strict=True))  # fmt: skip
    if not len(mine):
        return None
    order = np.arange(log.shape[1])
    order[mine] = theirs
    return tuple(order.tolist()), float(left[mine, theirs].mean())


def unexplained_share(log: Array, reference: Array) -> Array:
    """Return for each pair of elements what a straight line leaves of the log's spread: (A, A), NaN where constant."""
    mine, theirs = log - log.mean(axis=0), reference - reference.mean(axis=0)
    spread = np.sqrt((mine**2).sum(axis=0))[:, None] * np.sqrt((theirs**2).sum(axis=0))[None]
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.where(spread > 1e-9, mine.T @ theirs / spread, np.nan)
    left: Array = np.sqrt(np.clip(1 - correlation**2, 0, 1))
    return left


def explain_vector(
    name: str,
    labels: Sequence[str],
    log: Array,
    reference: Array,
    pairings: Mapping[int, Pairs],
    match: Match,
    normaliser: Normaliser | None,
) -> Iterator[Explanation]:
    """Yield what is wrong with a signal that was matched: delay, order, and the straight line of each element."""
    pairs = pairings[match.delay]
    mine, theirs = log[pairs.log], reference[pairs.reference]
    if match.cost > MAX_UNLIKE:
        yield Explanation(name, "unexplained", "no known change makes it what was recorded", match.own, match.cost,
                          len(pairs))  # fmt: skip
        return
    if match.delay:
        late = "late" if match.delay > 0 else "early"
        steps = f"{amount(abs(match.delay), 'control step')} {late}"
        yield Explanation(name, "delayed", steps, match.own, match.cost, len(pairs))
    moved = [index for index, other in enumerate(match.order) if index != other]
    if moved:
        where = ", ".join(f"{labels[index]} holds {labels[match.order[index]]}" for index in moved)
        yield Explanation(name, "permuted", where, match.own, match.cost, len(pairs))
    yield from _of_lines(name, labels, mine, theirs[:, list(match.order)], match.order, normaliser)


def _of_lines(
    name: str, labels: Sequence[str], mine: Array, theirs: Array, order: tuple[int, ...], normaliser: Normaliser | None
) -> Iterator[Explanation]:
    """Yield the changes of sign, unit, offset and normalisation, each with all of its elements."""
    changes: dict[tuple[str, str], list[tuple[int, float, float]]] = {}
    for index, other in enumerate(order):
        change = _line(mine[:, index], theirs[:, index], other, normaliser)
        if change is not None:
            kind, what, before, after = change
            changes.setdefault((kind, what), []).append((index, before, after))
    for (kind, what), found in changes.items():
        elements = "all elements" if len(found) == len(order) > 1 else ", ".join(labels[each[0]] for each in found)
        before, after = (float(np.mean([each[index] for each in found])) for index in (1, 2))
        yield Explanation(name, kind, f"{elements}{what and ': ' + what}", before, after, len(mine))


def _line(
    mine: Array, theirs: Array, other: int, normaliser: Normaliser | None
) -> tuple[str, str, float, float] | None:
    """Return kind and words of the simplest change of an element, and its error before and after; None for none."""
    spread, theirs_spread = float(mine.std()), float(theirs.std())
    if spread < 1e-9 or theirs_spread < 1e-9:
        return None
    free = float(np.corrcoef(mine, theirs)[0, 1])
    allowed = 1.5 * math.sqrt(max(0.0, 1 - free**2)) + NOISE
    before = _error(mine, theirs, spread)
    if before <= allowed or abs(free) < 1 - MAX_UNLIKE**2:
        return None
    for kind, what, values in _changes(mine, theirs, other, normaliser):
        after = _error(mine, values, spread)
        if after <= allowed and after <= BETTER * before:
            return kind, what, before, after
    slope = free * spread / theirs_spread
    offset = float(mine.mean()) - slope * float(theirs.mean())
    after = _error(mine, slope * theirs + offset, spread)
    return (
        ("scaled", f"{slope:.4g} times the recorded plus {offset:.4g}", before, after)
        if after <= BETTER * before
        else None
    )


def _changes(mine: Array, theirs: Array, other: int, normaliser: Normaliser | None) -> Iterator[tuple[str, str, Array]]:
    """Yield kind, words and values of known changes, the simplest first."""
    yield "negated", "", -theirs
    for factor, what in FACTORS.items():
        yield "scaled", f"{what} (a factor of {factor:.4g})", factor * theirs
        yield "scaled", f"{what} (a factor of {factor:.4g}), and negated", -factor * theirs
    if normaliser is not None:
        offset, scale = float(normaliser.offset[other]), float(normaliser.scale[other])
        yield "statistics", "it is normalised already", (theirs - offset) / scale
        yield "statistics", "it was un-normalised once more", theirs * scale + offset
    shift = float(np.mean(mine - theirs))
    yield "offset", f"by {shift:.4g}", theirs + shift
    shift = float(np.mean(mine + theirs))
    yield "negated", f"and shifted by {shift:.4g}", shift - theirs


def _error(mine: Array, values: Array, spread: float) -> float:
    return float(np.sqrt(np.mean((mine - values) ** 2))) / spread
