"""The vocabulary of measures: what each quantity is called, its unit, which way is better, and how a report shows it.

A quantity is a row of a file in this folder, or of a file of another package that an entry point of the group
``vlatool.measures`` names: there is no list to edit. What measures makes measurements with it
(``LATENCY_P50.measurement(4.2)``), what reads looks them up (``row.get(LATENCY_P50)``), and reports, ``compare`` and
the JSON schema show whatever is here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

from vlatool import registry
from vlatool.report import Measurement, Row

BETTER = ("", "less", "more")
HEADLINE, RECORDED_ACCURACY, PERCENTILES, MOTION, ELEMENTS, FURTHER, BOARDS = SECTIONS = (
    "headline", "recorded", "percentiles", "motion", "elements", "further", "boards",
)  # fmt: skip
"""Where a report shows a quantity: a column of the variants; the same unless episodes were played; the percentiles of
the latency; how the variants move; errors by action element; the further measurements; the boards of ``hwselect``."""
AUTOMATIC, PERCENT, POINTS, PLAIN = FORMS = ("", "percent", "points", "plain")
"""How a number is printed: with its unit, a share up to 1 in per cent; always in per cent; a difference of shares in
percentage points; never in per cent, and metres in millimetres."""
LAST_POSITION = 1000


@dataclass(frozen=True)
class Quantity:
    """What is measured or predicted, such as the median latency; a ``Measurement`` is one value of it.

    Args:
        name: Name in reports and in their JSON.
        unit: Unit, as in ``Measurement``; empty where it depends on the policy.
        title: Title in words; the name with spaces when empty.
        better: ``less``, ``more``, or empty where neither is.
        section: One of ``SECTIONS``.
        order: Position within its section; those without one follow in the order of the report.
        column: Title of its column in the table of variants; ``title`` when empty.
        host_column: The same in a report for a board other than this host; empty for what holds on any machine.
        form: One of ``FORMS``.
        interval: How its interval is derived; empty where it has none.
        of: Derives its measurement from a row whose other measurements and raw samples are complete, None where the row
            lacks what it needs; None for a quantity that a command measures itself.
        group: Title of the quantities that differ in ``part`` alone.
        part: The part of the name that the policy or the command gave, such as an action element.
    """

    name: str
    unit: str
    title: str = ""
    better: str = "less"
    section: str = FURTHER
    order: int = LAST_POSITION
    column: str = ""
    host_column: str = ""
    form: str = AUTOMATIC
    interval: str = ""
    of: Callable[[Row], Measurement | None] | None = None
    group: str = ""
    part: str = ""

    def __post_init__(self) -> None:
        known = (("better", self.better, BETTER), ("section", self.section, SECTIONS))
        for field, got, allowed in (*known, ("form", self.form, FORMS)):
            if got not in allowed:
                raise ValueError(f"{field} of {self.name} is {got!r}; allowed: {', '.join(map(repr, allowed))}")

    @property
    def words(self) -> str:
        """The title, or the name as words."""
        return self.title or self.name.replace("_", " ").replace(".", ", ")

    def measurement(
        self,
        value: float,
        *,
        where: str = "this host",
        samples: int = 0,
        low: float | None = None,
        high: float | None = None,
        confidence: float = 0.95,
        note: str = "",
    ) -> Measurement:
        """Return a measured value; the arguments are those of ``Measurement``."""
        return Measurement(self.name, value, self.unit, "measured", where, samples, low, high, confidence, note)

    def prediction(
        self,
        value: float,
        where: str,
        low: float | None = None,
        high: float | None = None,
        confidence: float = 0.95,
        note: str = "",
    ) -> Measurement:
        """Return a value that is predicted for a board; the arguments are those of ``Measurement``."""
        return Measurement(self.name, value, self.unit, "predicted", where, 0, low, high, confidence, note)

    def relabel(self, other: Measurement, note: str | None = None) -> Measurement:
        """Return the measurement of another quantity as one of this."""
        return replace(other, name=self.name, note=other.note if note is None else note)


@dataclass(frozen=True)
class Pattern:
    """Names of which one part is not known beforehand: ``motion.{metric}``."""

    text: str

    @cached_property
    def _ends(self) -> tuple[str, str]:
        before, _, rest = self.text.partition("{")
        return before, rest.partition("}")[2]

    def name(self, part: str) -> str:
        """Return the name with a part."""
        before, after = self._ends
        return f"{before}{part}{after}"

    def part(self, name: str) -> str | None:
        """Return the part of a name, None for a name that is not one of these."""
        before, after = self._ends
        inside = name.startswith(before) and name.endswith(after) and len(name) > len(before) + len(after)
        return name[len(before) : len(name) - len(after)] if inside else None

    def among(self, names: Iterable[str]) -> dict[str, str]:
        """Return part -> name of each of these names."""
        return {part: name for name in names if (part := self.part(name)) is not None}


@dataclass(frozen=True)
class Family:
    """Quantities that differ in one part of their names.

    Args:
        each: What they share; its name, and its title where it has one, have the part in braces.
    """

    each: Quantity

    @cached_property
    def pattern(self) -> Pattern:
        """Their names."""
        return Pattern(self.each.name)

    def quantity(self, part: str, unit: str | None = None) -> Quantity:
        """Return the quantity with a part, in a unit where it depends on the part."""
        words = part.replace("_", " ") if self.each.name.startswith("{") else part
        title = Pattern(self.each.title).name(words) if self.each.title else ""
        unit = self.each.unit if unit is None else unit
        return replace(self.each, name=self.pattern.name(part), title=title, unit=unit, part=part)

    def members(self, row: Row) -> dict[str, Measurement]:
        """Return part -> what was measured, of those that a row has."""
        found = ((self.pattern.part(item.name), item) for item in row.measurements if item.origin == "measured")
        return {part: item for part, item in found if part is not None}


@cache
def quantities() -> dict[str, Quantity]:
    """Return name -> quantity, of vlatool and then of other packages; a name that is taken stays as it is.

    Raises:
        PluginError: when the file of another package cannot be imported, or has no quantity.
    """
    found: dict[str, Quantity] = {}
    for quantity in registry.values("measures", Quantity, Family):
        if isinstance(quantity, Quantity):
            found.setdefault(quantity.name, quantity)
    return found


@cache
def families() -> tuple[Family, ...]:
    """Return the families, those whose names begin alike for longest first; raises PluginError as ``quantities``."""
    found = [value for value in registry.values("measures", Quantity, Family) if isinstance(value, Family)]
    return tuple(sorted(found, key=lambda family: -family.each.name.index("{")))


@cache
def quantity_of(name: str) -> Quantity:
    """Return the quantity of a name that a report or a user gives; one that only has this name where it is unknown."""
    if name in quantities():
        return quantities()[name]
    parts = ((family, family.pattern.part(name)) for family in families())
    return next((family.quantity(part) for family, part in parts if part is not None), Quantity(name, ""))


def with_derived(row: Row) -> Row:
    """Return the row with the quantities that are derived from its other numbers (``Quantity.of``)."""
    deriving = [quantity for quantity in quantities().values() if quantity.of is not None and row.get(quantity) is None]
    found = (quantity.of(row) for quantity in deriving if quantity.of is not None)
    return replace(row, measurements=(*row.measurements, *(item for item in found if item is not None)))


def descriptions() -> dict[str, dict[str, Any]]:
    """Return name -> what the JSON schema says of a quantity; the names of families have a part in braces."""
    every = (*quantities().values(), *(family.each for family in families()))
    return {
        each.name: {"title": each.words, "unit": each.unit, "better": each.better, "section": each.section,
                    "interval": each.interval}
        for each in sorted(every, key=lambda each: each.name)
    }  # fmt: skip
