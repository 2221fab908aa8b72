"""The episode in which two variants differ most, to be looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from vlatool.accuracy.success_comparison import Outcome
from vlatool.measures import series, tables
from vlatool.report import Row


def differs_most(base: Sequence[Outcome], own: Sequence[Outcome]) -> int:
    """Return the index of the pair that differs most: in success, then in steps, then in the worst ratio of motion."""

    def difference(index: int) -> tuple[float, ...]:
        one, two = base[index], own[index]
        alike = (abs(two.motion[name] - value) / value for name, value in one.motion.items()
                 if value > 0 and name in two.motion)  # fmt: skip
        return abs(one.success - two.success), abs(one.steps - two.steps), max(alike, default=0.0), -index

    return max(range(len(base)), key=difference)


def stands_out(outcomes: Sequence[Outcome]) -> int:
    """Return the index of the first episode that fails; of the longest one where none does."""
    return max(range(len(outcomes)), key=lambda index: (not outcomes[index].success, _length(outcomes[index]), -index))


def _length(outcome: Outcome) -> int:
    """Return how much the length of an episode counts: nothing where it fails."""
    return outcome.steps if outcome.success else 0


def with_episode(row: Row, outcome: Outcome) -> Row:
    """Return the row with the steps of an episode, and a line on how it ended."""
    raw = {series.EPISODE.name(name): list(values) for name, values in outcome.series.items()}
    record = {"task": outcome.task, "seed": outcome.seed, "instruction": outcome.instruction,
              "success": "yes" if outcome.success else "no", "steps": outcome.steps}  # fmt: skip
    told = {name: value for name, value in record.items() if value != ""}
    return replace(row, raw={**row.raw, **raw}, details={**row.details, tables.EPISODE: [told]})
