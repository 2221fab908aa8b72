"""What a plan may cost in accuracy, in a measure that recorded observations give."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from vlatool.errors import RecipeError, suggest
from vlatool.measures import quantities, quantity_of
from vlatool.measures.actions import AGREEMENT_BASELINE, DISAGREEMENT, ERROR_BASELINE, ERROR_BASELINE_OF
from vlatool.optimize.recipe import Limits
from vlatool.report import Measurement, Row

if TYPE_CHECKING:
    from vlatool.bundle.spec import PolicySpec, TensorSpec

PROXY = 0.05
"""Error against float32 up to which a plan is worth an evaluation, where the closed loop or the expert decides."""


@dataclass(frozen=True)
class Budget:
    """What a plan may cost in accuracy, in a measure that recorded observations give.

    Args:
        name: The measurement, or ``unit:UNIT`` for the worst action element of that unit.
    """

    name: str
    value: float

    def of(self, row: Row) -> Measurement | None:
        """Return the measurement of a row that the budget is about, None when there is none."""
        if self.name == DISAGREEMENT.name:
            agreement = row.get(AGREEMENT_BASELINE)
            return None if agreement is None else replace(agreement, name=self.name, value=1.0 - agreement.value)
        if self.name.startswith("unit:"):
            unit = self.name.partition(":")[2]
            alike = (m for m in ERROR_BASELINE_OF.members(row).values() if m.unit == unit)
            return max(alike, key=lambda m: m.value, default=None)
        return row.get(quantity_of(self.name)) or row.get(ERROR_BASELINE_OF.quantity(self.name))

    def check_name(self, action: TensorSpec) -> None:
        """Refuse a name that nothing has: no measure, and no element or unit of the action; raises RecipeError."""
        units = sorted({f"unit:{unit}" for unit in action.units() if unit})
        known = [*quantities(), DISAGREEMENT.name, *action.labels, *units]
        if self.name not in known:
            raise RecipeError(
                f"--max-drop names '{self.name}', which vlatool does not measure; {suggest(self.name, known)}.",
                "leave the name out to bound the success or the error that is measured",
            )

    def require(self, row: Row) -> Measurement:
        """Return the row's measurement for the budget; raises RecipeError, naming those it has, when it lacks that."""
        measurement = self.of(row)
        if measurement is not None:
            return measurement
        elements = ERROR_BASELINE_OF.members(row)
        known = [ERROR_BASELINE_OF.pattern.part(m.name) or m.name for m in row.measurements if m.origin == "measured"]
        units = {f"unit:{m.unit}" for m in elements.values()}
        raise RecipeError(
            f"--max-drop names '{self.name}', which is not measured on this policy; "
            f"{suggest(self.name, [*known, *sorted(units)])}.",
            "leave the name out to bound the success or the error that is measured",
        )


def budget_of(limits: Limits, spec: PolicySpec, proxy: bool = True) -> Budget:
    """Return the budget on recorded observations.

    Args:
        proxy: Whether something else decides in the end (episodes, the expert's actions), so that a plan is only worth
            a look when it is near float32.
    """
    if limits.metric:
        return Budget(limits.metric, limits.max_metric or 0.0)
    name = DISAGREEMENT.name if spec.action.kind == "discrete" else ERROR_BASELINE.name
    return Budget(name, min(max(PROXY, limits.max_drop), limits.max_distance) if proxy else limits.max_drop)


def distance_of(row: Row) -> Measurement | None:
    """Return how far a row's actions are from float32's own, None when that is not measured.

    Continuous: the mean |difference| by float32's standard deviation; discrete: the share of other answers.
    """
    return Budget(DISAGREEMENT.name, 0.0).of(row) or row.get(ERROR_BASELINE)
