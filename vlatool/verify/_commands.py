"""Commands that are in another order, of another sign or unit: judged by all that follows them.

The signals that follow the commands tell more of them than the commands of themselves: each change of the commands is
judged by how well all signals fit with it. From no change, exchanges of two elements, signs and factors are taken as
long as one makes them fit better.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from vlatool.verify._model import Model
from vlatool.verify._search import (
    FACTOR_KIND,
    ORDER_KIND,
    PRIOR,
    SIGN_KIND,
    SIGNS_FACTORS,
    Component,
    Finding,
    Fix,
    cycles,
)
from vlatool.verify._series import Series

MAX_PASSES, MAX_WIDTH = 6, 32
"""Rounds over all changes, and elements of commands that are judged in this way."""


@dataclass(frozen=True, eq=False)
class _Fits:
    """How well all signals of a log fit with a change of its commands, less what that costs."""

    model: Model
    series: Series

    def __call__(self, fix: Fix) -> float:
        fixed = self.series.with_signals((self.model.names.commands,), fix.apply)
        return self.model.fit_of(fixed, affected_signals(self.model)) - _cost(fix)


def best_change(model: Model, series: Series) -> Finding:
    """Return the change of commands that are numbers with which all signals fit best; without components for none."""
    name = model.names.commands
    width = series.values[name].shape[1] if name else 0
    fix = Fix(tuple(range(width)), (1,) * width, (1.0,) * width, (0.0,) * width)
    if model.discrete or not 0 < width <= MAX_WIDTH or len(affected_signals(model)) < 2:
        return Finding(fix, ())
    fits = _Fits(model, series)
    best = fits(fix)
    for _ in range(MAX_PASSES):
        before = fix
        for other in _neighbours(width):
            if (candidate := other(fix)) != fix and (value := fits(candidate)) > best:
                fix, best = candidate, value
        if fix == before:
            break
    return _finding(model, fits, fix, best)


def _cost(fix: Fix) -> float:
    moved = sum(len(cycle) - 1 for cycle in cycles(fix.order))
    return PRIOR * (moved + sum(sign < 0 for sign in fix.signs) + sum(factor != 1 for factor in fix.factors))


def _neighbours(width: int) -> Iterator[Callable[[Fix], Fix]]:
    """Yield exchanges of two elements, and each sign and factor of one, but those that make it smaller.

    Commands that are too large are seen by themselves; to divide one may fit better because it is silent then.
    """
    yield from (functools.partial(_exchanged, one=one, other=other) for one in range(width) for other in range(one))
    yield from (functools.partial(_scaled, index=index, sign=sign, factor=factor)
                for index in range(width) for sign, factor in SIGNS_FACTORS if factor <= 1)  # fmt: skip


def _exchanged(fix: Fix, one: int, other: int) -> Fix:
    order = list(fix.order)
    order[one], order[other] = order[other], order[one]
    return replace(fix, order=tuple(order))


def _scaled(fix: Fix, index: int, sign: int, factor: float) -> Fix:
    signs, factors = list(fix.signs), list(fix.factors)
    signs[index], factors[index] = sign, factor
    return replace(fix, signs=tuple(signs), factors=tuple(factors))


def _without(fix: Fix, cycle: list[int]) -> Fix:
    return replace(fix, order=tuple(at if at in cycle else to for at, to in enumerate(fix.order)))


def _finding(model: Model, fits: _Fits, fix: Fix, best: float) -> Finding:
    """Return the parts of a change for which more speaks than right logs have, each against the change without it."""
    parts = [(_without(fix, cycle), Component(ORDER_KIND, tuple(cycle), 0.0)) for cycle in cycles(fix.order)]
    for index, (sign, factor) in enumerate(zip(fix.signs, fix.factors, strict=True)):
        if (sign, factor) != (1, 1.0):
            kind = FACTOR_KIND if factor != 1 else SIGN_KIND
            parts.append((_scaled(fix, index, 1, 1.0), Component(kind, (index,), 0.0, factor, sign < 0)))
    found, kept = list[Component](), fix
    for other, part in parts:
        evidence = best - fits(other)
        if evidence > _needed(model, part.kind):
            found.append(replace(part, evidence=evidence))
        elif part.kind == ORDER_KIND:
            kept = _without(kept, list(part.elements))
        else:
            kept = _scaled(kept, part.elements[0], 1, 1.0)
    return Finding(kept, tuple(found))


def _needed(model: Model, kind: str) -> float:
    """Return what is needed for a change of the commands: as much as for one of each signal that it changes."""
    return sum(model.needed[each][kind] for each in affected_signals(model))


def affected_signals(model: Model) -> tuple[str, ...]:
    """Return the signals that fit otherwise when the commands change: these, and what is predicted from them."""
    name = model.names.commands
    followers = [each for each, known in model.predictions.items() if any(view.view.commands for view in known)]
    return tuple(dict.fromkeys((name, *followers)))
