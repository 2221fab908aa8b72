"""A student that is derived from the policy itself: which stages make it, from what a person writes."""

from __future__ import annotations

import math
from typing import Any

from vlatool.errors import RecipeError

DEPTH = "prune.depth"
STAGES = {"depth": DEPTH, "width": "prune.structured"}
"""Share that stays -> the stage that takes the rest away; in this order, so that no width is ranked for nothing."""
EXAMPLE = "depth=0.5,width=0.75"
DECIMALS = 6
"""Decimals of a share that count: 1 - 0.9 is then the 0.1 that a person would have asked the stage for."""


def student_steps(text: str) -> tuple[tuple[str, dict[str, Any]], ...]:
    """Return the stages that make a student, each with its options.

    Args:
        text: ``depth=0.5,width=0.75``, or one of them: the share of the blocks of each stack, and the share of the
            multiply-accumulates, that stay. None are made of an empty one.

    Example:
        >>> student_steps("width=0.75, depth=0.5")
        (('prune.depth', {'ratio': 0.5}), ('prune.structured', {'ratio': 0.25}))
    """
    shares: dict[str, float] = {}
    for part in text.split(",") if text else ():
        name, equals, value = (each.strip() for each in part.partition("="))
        if not (name and equals and value):
            raise RecipeError(
                f"--student says how much stays, such as {EXAMPLE} (of the blocks, and of the work); got '{text}'.",
                f"write it as {EXAMPLE}",
            )
        if name not in STAGES:
            raise RecipeError.unknown(f"--student knows no '{name}'", name, STAGES)
        if name in shares:
            raise RecipeError(f"--student names {name} twice: '{text}'.", "name it once")
        shares[name] = _share(name, value)
    goes = {name: round(1 - shares[name], DECIMALS) for name in STAGES if shares.get(name, 1.0) < 1}
    if text and not goes:
        raise RecipeError(f"--student {text} takes nothing away.", f"ask for less than 1, such as {EXAMPLE}")
    return tuple((STAGES[name], {"ratio": ratio}) for name, ratio in goes.items())


def _share(name: str, value: str) -> float:
    try:
        share = round(float(value), DECIMALS)
    except ValueError:
        share = math.nan
    if not 0 < share <= 1:
        raise RecipeError(
            f"--student {name}={value}: what stays is a share above 0, at most 1, such as 0.5.",
            f"write it as {EXAMPLE}",
        )
    return share
