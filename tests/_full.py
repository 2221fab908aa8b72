"""Tests of many draws, kills or cases have a small form in ``make test``, and their full one in ``make soak``."""

from __future__ import annotations

import os
from typing import TypeVar

VARIABLE = "VLATOOL_TESTS_FULL"
"""Set where pytest has the option ``--full``, in its workers too, before tests are collected."""
T = TypeVar("T")


def full() -> bool:
    """Whether tests take their full form."""
    return bool(os.environ.get(VARIABLE))


def small_or_full(small: T, whole: T) -> T:
    """Return how many draws, or which cases, a test takes."""
    return whole if full() else small
