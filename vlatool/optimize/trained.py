"""How the candidates were trained, as the reports beside their stages say."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from vlatool.bundle.bundle import REPORTS, Bundle
from vlatool.errors import DataError
from vlatool.report import TRAINED, TRAINING_TIME, Row, read_report


def trainings(stages: Iterable[Bundle]) -> tuple[Row, ...]:
    """Return what the stages of a candidate say of their trainings; those that were not trained say nothing."""
    rows: list[Row] = []
    for bundle in stages:
        try:
            rows += read_report(bundle.path / REPORTS).rows if (bundle.path / REPORTS).is_dir() else ()
        except DataError:  # beside the bundle, not of it: nothing else depends on it
            continue
    return tuple(rows)


def with_trainings(row: Row, trained: Iterable[Row]) -> Row:
    """Return the row of a candidate with losses, rounds and times of its trainings."""
    for other in trained:
        raw = {name: values for name, values in other.raw.items() if name.startswith(TRAINED)}
        details = {name: records for name, records in other.details.items() if name.startswith(TRAINED)}
        took = tuple(item for item in other.measurements if item.name.startswith(TRAINING_TIME))
        row = replace(row, raw={**row.raw, **raw}, details={**row.details, **details},
                      measurements=(*row.measurements, *took))  # fmt: skip
    return row
