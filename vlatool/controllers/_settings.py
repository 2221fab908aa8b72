"""Checks of settings of controllers."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from vlatool.errors import UsageError


def check_finite(controller: Any) -> None:
    """Raise UsageError unless every setting that is a number is finite: NaN and infinity would switch checks off."""
    for entry in dataclasses.fields(controller):
        value = getattr(controller, entry.name, None)
        if isinstance(value, float) and not math.isfinite(value):
            raise UsageError(f"{entry.name} is {value!r}; allowed: a finite number.", f"change {entry.name}")


def check_rate(rate: float) -> None:
    """Raise UsageError unless a number of steps in a second can be kept."""
    if not 0.0 < rate <= 1000.0:
        raise UsageError(f"rate is {rate!r}; allowed: above 0, up to 1000 steps in a second.", "write for example 10")


def check_speeds(what: str, slowest: float, fastest: float) -> None:
    """Raise UsageError unless 0 <= slowest <= fastest, both finite; ``what`` is the end of both names."""
    if not 0.0 <= slowest <= fastest < math.inf:
        raise UsageError(
            f"min_{what} is {slowest!r} and max_{what} {fastest!r}; allowed: 0 <= minimum <= maximum.",
            f"raise max_{what}, or lower min_{what}",
        )


def check_range(name: str, value: float, low: float, high: float = math.inf) -> None:
    """Raise UsageError unless low <= value <= high."""
    if not low <= value <= high:
        allowed = f"from {low:g} to {high:g}" if math.isfinite(high) else f"{low:g} or more"
        raise UsageError(f"{name} is {value!r}; allowed: {allowed}.", f"change {name}")
