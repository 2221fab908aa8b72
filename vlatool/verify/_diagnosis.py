"""Which signals of a log are wrong, and how: changes that make all signals follow each other as in the reference."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping

from vlatool.verify._commands import best_change
from vlatool.verify._model import Model
from vlatool.verify._search import (
    DELAY_KIND,
    DELAYS,
    PRIOR,
    Finding,
    delay_finding,
    scale_finding,
)
from vlatool.verify._series import Array, Series
from vlatool.verify._views import PLACES

Scales = Mapping[str, tuple[Array, Array]]
"""Signal -> offset and scale of its normalisation."""


def explain(model: Model, series: Series, scales: Scales) -> tuple[list[tuple[str, Finding]], Series]:
    """Return the signals that are wrong with their findings, and the log as it would be without these.

    One after the other: of the signals that a change would make right, the one whose change makes all of them fit best.

    Args:
        scales: signal -> offset and scale of its normalisation.
    """
    found: dict[str, Finding] = {}
    while True:
        fixes = [(_gain(model, series, finding, fixed), name, finding, fixed)
                 for name, finding, fixed in _candidates(model, series, scales, found)]  # fmt: skip
        best = max(fixes, key=lambda each: each[0], default=None)
        if best is None or best[0] <= min(model.needed[best[1]].values()):
            return list(found.items()), series
        _, name, found[name], series = best


def _with_fix(series: Series, name: str, finding: Finding) -> Series:
    return series.with_signals(_with_places(name, series), finding.fix.apply, finding.fix.delay)


def _gain(model: Model, series: Series, finding: Finding, fixed: Series) -> float:
    """Return how much better all signals fit with a change, on the rows that it leaves."""
    before = model.fit_of(series.part(series.inside(finding.fix.delay)))
    return model.fit_of(fixed) - before - finding.cost


def _late_commands(model: Model, series: Series, evidence: float) -> Iterator[tuple[str, Finding, Series]]:
    """Yield delays of the commands, which a delay of what follows them may be just as well."""
    name = model.names.commands
    width = series.values[name].shape[1] if name else 0
    for delay in DELAYS[1:] if name else ():
        finding = delay_finding(width, delay, evidence)
        yield name, finding, series.with_signals((name,), finding.fix.apply, delay)


def _with_places(name: str, series: Series) -> tuple[str, ...]:
    """Return a signal and, of an image, its places, which are late with it."""
    return (name, name + PLACES) if name + PLACES in series.values else (name,)


def _candidates(
    model: Model, series: Series, scales: Scales, found: Container[str]
) -> Iterator[tuple[str, Finding, Series]]:
    """Yield the signals that a change makes fit, but those that were found, and the log with it."""
    late, commands = 0.0, model.names.commands
    for name in model.signals:
        finding = model.finding(series, name, model.needed[name])
        late = max(late, *(each.evidence for each in finding.components if each.kind == DELAY_KIND), 0.0)
        if finding.components and name not in found:
            yield name, finding, _with_fix(series, name, finding)
        if name in scales and name not in found:
            yield from _of_scale(model, series, name, *scales[name])
    if commands not in found and (better := best_change(model, series)).components:
        yield commands, better, _with_fix(series, commands, better)
    if late and commands not in found:
        yield from _late_commands(model, series, late)


def _of_scale(
    model: Model, series: Series, name: str, offset: Array, scale: Array
) -> Iterator[tuple[str, Finding, Series]]:
    """Yield whether a signal is normalised once too often, or the other way round."""
    before = model.tables(series, name).right
    for words, one, other in (("it is normalised already", -offset / scale, 1 / scale),
                              ("it was un-normalised once more", offset, scale)):  # fmt: skip
        fixed = series.with_signals((name,), scale_finding(one, other, words, 0.0).fix.apply)
        evidence = model.tables(fixed, name).right - before - PRIOR
        if evidence > max(model.needed[name].values()):
            yield name, scale_finding(one, other, words, evidence), fixed
