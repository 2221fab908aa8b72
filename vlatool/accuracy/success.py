"""Success of an episode, from the info of its steps."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.errors import DataError

KEYS = ("success", "is_success")
"""Keys of success in the info of a step; the first one that is present counts."""
FIX = (
    "let every episode tell it, also when it fails: info['success'] (or info['is_success']) is True or False in the "
    "last step, or in an earlier one; a reward alone does not say it (docs/guides/environment.md)"
)


class Success:
    """Success of one episode, from the info of every step: the last value counts."""

    def __init__(self) -> None:
        self._said: bool | None = None

    def look(self, info: Any) -> None:
        """Read the info of a step; raises DataError when one of the keys has another value than true or false."""
        said = reported_success(info)
        self._said = self._said if said is None else said

    def at_the_end(self, task: str, seed: int) -> bool:
        """Return whether the episode succeeded; raises DataError when no step of the episode told it."""
        if self._said is None:
            raise DataError(
                f"The environment of task '{task}' never told whether the episode of seed {seed} succeeded: the info "
                "of no step has 'success' or 'is_success'.",
                FIX,
            )
        return self._said


def reported_success(info: Any) -> bool | None:
    """Return what the info of a step says of success, None when it says nothing.

    A vector environment of one keeps what belongs to the end in ``final_info``.

    Raises:
        DataError: when one of the keys is there with something else than true or false.
    """
    if not isinstance(info, Mapping):
        return None
    for key in KEYS:
        if (value := _only(info.get(key))) is not None:
            return _truth(key, value)
    return reported_success(_only(info.get("final_info")))


def _only(value: Any) -> Any:
    """Return the one element of an array or a list of one; everything else as it is."""
    if isinstance(value, np.ndarray | list | tuple) and np.size(np.asarray(value, dtype=object)) == 1:
        return np.asarray(value, dtype=object).reshape(-1)[0]
    return value


def _truth(key: str, value: Any) -> bool:
    truth = truth_of(value)
    if truth is None:
        raise DataError(f"info['{key}'] is {value!r:.60}; allowed: true or false (or 1 or 0).", FIX)
    return truth


def truth_of(value: Any) -> bool | None:
    """Return what true, false, 1 or 0 says, of Python or numpy, or an array of one of them; None for all else.

    Example:
        >>> truth_of(1), truth_of([False]), truth_of("False"), truth_of(None)
        (True, False, None, None)
    """
    value, number = _only(value), None
    with contextlib.suppress(TypeError, ValueError):
        number = None if isinstance(value, str | bytes) else float(value)
    return bool(number) if number in (0.0, 1.0) else None
