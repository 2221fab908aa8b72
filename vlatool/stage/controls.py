"""What is recorded of how a bundle was made: as a control, by predictions, by trainings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from vlatool.bundle.bundle import REPORTS, Bundle
from vlatool.errors import DataError
from vlatool.report import Row, read_report
from vlatool.stage.finish import history

BOARD = "board"
"""Option of a stage that predicts instead of measuring."""
OPTION = "control"
"""Option of a stage that says so, whatever it is but ``none``, its default."""
PRUNED_KEY = "pruned"
"""Key of what a stage that removes parts of a policy records: the shares of the work ``asked`` for and ``reached``."""


def controls(bundle: Bundle) -> tuple[str, ...]:
    """Return a sentence for each stage of a bundle's build record that was a control; none for a bundle to be used."""
    return tuple(_controls(history(bundle)))


def reservations(bundle: Bundle) -> tuple[str, ...]:
    """Return a sentence for each stage of a bundle's build record that was a control, chose by predictions, or pruned.

    In this order.
    """
    record = history(bundle)
    return (*_controls(record), *_predictions(record), *_removed(record))


def training_rows(stages: Iterable[Bundle]) -> tuple[Row, ...]:
    """Return what the reports beside bundles say of their trainings; a bundle that was not trained says nothing."""
    rows: list[Row] = []
    for bundle in stages:
        try:
            rows += read_report(bundle.path / REPORTS).rows if (bundle.path / REPORTS).is_dir() else ()
        except DataError:  # beside the bundle, not of it: nothing else depends on it
            continue
    return tuple(rows)


Record = tuple[Mapping[str, Any], ...]


def _controls(record: Record) -> Iterator[str]:
    for entry in record:
        if value := entry.get("options", {}).get(OPTION):
            yield f"a control, not for a robot: {entry['stage']} was run with --{OPTION} {value}"


def _predictions(record: Record) -> Iterator[str]:
    for entry in record:
        options = entry.get("options", {})
        if options.get(BOARD) and "target_ms" in options:
            aim = f"{options[BOARD]} (target {options['target_ms']:g} ms)"
            yield f"{entry['stage']} chose what stays by predictions for {aim}, not by measurements"


def _removed(record: Record) -> Iterator[str]:
    for entry in record:
        if work := entry.get(PRUNED_KEY):
            share = f"asked for {work['asked']:.1%} less work, reached {work['reached']:.1%}"
            yield f"{entry['stage']}: {share}"
