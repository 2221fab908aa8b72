"""What is right: how far actions may be from others, and what a table says about those that are not."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

RIGHT, REFUSED, WARNED, SKIPPED, WRONG, UNTRUE = "ok", "refused", "warned", "not tried", "WRONG", "NOT REFUSED"
BAD = (WRONG, UNTRUE)
OF_ONE = 2.0
"""How many times the limit of all observations a single one may differ: a small action makes a large relative one."""


@dataclass(frozen=True)
class Difference:
    """How far actions are from others.

    Args:
        worst: Largest relative L2 difference of one observation.
        of_all: Relative L2 difference of all of them together.
    """

    worst: float
    of_all: float

    def within(self, limit: float) -> bool:
        """Say whether all of them together keep to a limit, and each of them to ``OF_ONE`` times as much."""
        return self.of_all <= limit and self.worst <= OF_ONE * limit


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Args:
        where: Words that say which processor, engine and policy.
        bundle: The variant.
        difference: From what the actions should be; None when there are none.
        limit: Largest difference of all observations together that is rounding.
        refused: With which error ``load`` refuses it; empty when it loads.
        warned: What warns about it before it runs; empty when nothing does.
        must: ``load``: it has to load; ``refuse``: it has to compute something else and be refused; ``tell``:
            right, or refused for what it computes, or warned about.
        note: What else is to be said.
        skipped: Why it was not tried; empty when it was.
    """

    where: tuple[str, ...]
    bundle: str
    difference: Difference | None
    limit: float
    refused: str = ""
    warned: str = ""
    must: str = "load"
    note: str = ""
    skipped: str = ""

    @property
    def verdict(self) -> str:
        """One of the words above."""
        if self.skipped:
            return SKIPPED
        if self.must == "refuse":
            otherwise = self.difference is not None and not self.difference.within(self.limit)
            return REFUSED if self.refused == "GraphError" and otherwise else UNTRUE
        if self.refused:
            return REFUSED if self.must == "tell" and self.refused == "GraphError" else WRONG
        if self.difference is not None and self.difference.within(self.limit):
            return RIGHT
        return WARNED if self.warned and self.must == "tell" else WRONG


def difference(got: Any, wanted: Any) -> Difference:
    """Return how far actions are from others; infinitely for another size, and where they are no numbers.

    Args:
        got: (N, ...), one row an observation.
        wanted: The same.
    """
    if got.shape != wanted.shape:
        return Difference(math.inf, math.inf)
    count = len(wanted)
    one, other = (np.asarray(each, np.float64).reshape(count, -1) for each in (got, wanted))
    if not np.isfinite(one).all() or not np.isfinite(other).all():
        return Difference(math.inf, math.inf)
    apart, sizes = np.linalg.norm(one - other, axis=1), np.linalg.norm(other, axis=1)
    worst = float((apart / np.where(sizes > 0, sizes, 1)).max())
    total = float(np.linalg.norm(apart)) / (float(np.linalg.norm(sizes)) or 1.0)
    return Difference(worst, total)


def table(titles: Sequence[str], rows: Iterable[Row]) -> list[str]:
    """Return the lines of a Markdown table, one for each row."""
    head = [*titles, "bundle", "worst", "all", "limit", "verdict"]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for row in rows:
        found = row.difference
        figures = ["-", "-"] if found is None else [f"{found.worst:.1e}", f"{found.of_all:.1e}"]
        said = "; ".join(filter(None, [row.verdict, row.skipped, shortened(row.refused and row.note), row.warned]))
        lines.append(f"| {' | '.join([*row.where, row.bundle, *figures, f'{row.limit:g}', said])} |")
    return lines


def shortened(text: str, most: int = 90) -> str:
    """Return the beginning of a text that fits into a cell."""
    line = " ".join(text.split()).replace("|", "/")
    return line if len(line) <= most else f"{line[: most - 3]}..."


def exit_code(rows: Iterable[Row]) -> int:
    """Return 1 when a row is wrong, or was not refused and had to be, and when there are no rows; else 0."""
    verdicts = [row.verdict for row in rows]
    return 1 if not verdicts or any(verdict in BAD for verdict in verdicts) else 0


def summed_up(rows: Sequence[Row]) -> str:
    """Say how many rows have which verdict."""
    verdicts = [row.verdict for row in rows]
    return ", ".join(f"{verdicts.count(each)} {each}" for each in dict.fromkeys(verdicts)) or "nothing was tried"
