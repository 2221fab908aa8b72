"""How candidates were trained, in their rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from vlatool.measures import series, tables
from vlatool.measures.training import TRAINING_TIME
from vlatool.report import Measurement, Row


def with_wrong_instruction(row: Row, told: Measurement | None, reference: Measurement | None) -> Row:
    """Return the row of a trained candidate with how often it succeeds when it is told the wrong instruction.

    Args:
        told: The candidate's success; None where it is not known.
    """
    if told is None or reference is None:
        return row
    said = f"{told.value:.1%} of {told.samples} episodes succeed (float32: {reference.value:.1%})"
    teachers = {
        name: [{**record, "with the wrong instruction": said} for record in records]
        for name, records in row.details.items() if tables.TEACHER.part(name) is not None
    }  # fmt: skip
    return replace(row, measurements=(*row.measurements, told), details={**row.details, **teachers})


def with_trainings(row: Row, trained: Iterable[Row]) -> Row:
    """Return the row of a candidate with losses, rounds and times of its trainings."""
    for other in trained:
        raw = {name: values for name, values in other.raw.items() if series.LOSSES.part(name) is not None}
        details = {name: records for name, records in other.details.items() if tables.ROUNDS.part(name) is not None}
        took = TRAINING_TIME.members(other).values()
        row = replace(row, raw={**row.raw, **raw}, details={**row.details, **details},
                      measurements=(*row.measurements, *took))  # fmt: skip
    return row
