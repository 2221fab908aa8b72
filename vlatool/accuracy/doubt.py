"""Reasons for which the episodes of two policies decide nothing, as values with their words."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from vlatool.motion.measure import MIN_PAIRS
from vlatool.stats.starts import MIN_DISTINCT_STARTS

MIN_KNOWN_SHARE = 0.9
"""Share of the episodes in which both succeed that must tell a metric of both, or nothing is claimed of it."""


class Cause(Enum):
    """Reason for which episodes decide nothing; the value is the text about it."""

    RARELY_KNOWN = f"known of both in {{count}} of {{of}} common successes, and it takes {MIN_KNOWN_SHARE:.0%}"
    MISSING_MORE_OFTEN = "missing in {count} common successes where the baseline has it, the other way round in {of}"
    FEW_STARTS = f"{{count}} distinct starts, and it takes {MIN_PAIRS}"
    REPEATED_STARTS = f"{{of}} episodes of {{count}} distinct starts decide nothing (from {MIN_DISTINCT_STARTS})"
    FEW_PAIRS = f"{{count}} pairs, and it takes {MIN_PAIRS}"
    ZEROS = "too few pairs in which the baseline's is not 0"


@dataclass(frozen=True)
class Doubt:
    """A reason for which episodes decide nothing, with its numbers.

    Args:
        count: number of what there is too little of.
        of: number that it is compared with.
    """

    cause: Cause
    count: int = 0
    of: int = 0

    def __str__(self) -> str:
        return self.cause.value.format(count=self.count, of=self.of)
