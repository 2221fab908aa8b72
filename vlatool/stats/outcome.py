"""What a statistical decision, and everything that rests on one, comes to."""

from __future__ import annotations

from enum import Enum


class Outcome(str, Enum):
    """What a claim, or one number of it, was found to be; the worst first."""

    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"
    PASS = "pass"
