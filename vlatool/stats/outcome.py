"""Outcome of a statistical decision, and of everything that rests on one."""

from __future__ import annotations

from enum import Enum


class Outcome(str, Enum):
    """Outcome of a claim, or of one of its numbers; the worst first."""

    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"
    PASS = "pass"
