"""What a caller passes to ``load``: each value is as documented, or a one-sentence error says what is wrong."""

from __future__ import annotations

import math
import numbers
import os
from typing import Any

from vlatool.errors import UsageError

MOST_THREADS = 1024
RECORD, WARN, REQUIRE = "record", "warn", "require"
PROOFS = ("", RECORD, WARN, REQUIRE)
"""What ``load`` does about what an engine ran: nothing, keep a record, warn where it is not what was asked for, refuse
that."""


def check_path(path: Any, of: str = "bundle") -> None:
    """Refuse anything but a path; raises UsageError naming what it is."""
    if not isinstance(path, str | os.PathLike):
        raise UsageError(
            f"The path of the {of} is a {type(path).__name__}; allowed: text or a Path.",
            "pass the path as a str or a pathlib.Path",
        )


def check_whole(name: str, value: Any, least: int, most: float = math.inf, *, optional: bool = False) -> None:
    """Refuse anything but a whole number from ``least`` to ``most``; None too, unless it is optional.

    Raises:
        UsageError: naming the argument, what it is and what is allowed.
    """
    if optional and value is None:
        return
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not whole or not least <= value <= most:
        upto = "" if most == math.inf else f" to {most:.0f}"
        raise _refused(name, value, f"a whole number from {least}{upto}", optional)


def check_positive(name: str, value: Any, unit: str, *, optional: bool = False, zero: bool = False) -> None:
    """Refuse anything but a finite number above 0 (from 0 where ``zero``); None too, unless it is optional.

    Raises:
        UsageError: naming the argument, what it is and what is allowed.
    """
    if optional and value is None:
        return
    number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not number or not (0 < value < math.inf or (zero and value == 0)):
        raise _refused(name, value, f"{unit} {'from' if zero else 'above'} 0", optional)


def _refused(name: str, value: Any, allowed: str, optional: bool) -> UsageError:
    return UsageError(
        f"{name} is {value!r}; allowed: {allowed}{', or None' if optional else ''}.", f"pass {name}={allowed}"
    )


def check_load(
    path: Any, threads: Any, seed: Any, warmup: Any, tolerance: Any, first_run_s: Any, memory_mb: Any, proof: Any = ""
) -> None:
    """Check all arguments of ``load``; raises UsageError for the first invalid one."""
    check_path(path)
    check_whole("threads", threads, 1, MOST_THREADS, optional=True)
    check_whole("seed", seed, 0, optional=True)
    check_whole("warmup", warmup, 0)
    check_positive("golden_tolerance", tolerance, "a number", optional=True, zero=True)
    check_positive("first_run_s", first_run_s, "a number of seconds")
    check_positive("memory_mb", memory_mb, "a number of 10^6 bytes", optional=True)
    if proof not in PROOFS:
        raise UsageError(
            f"engine_proof is {proof!r}; allowed: {', '.join(map(repr, PROOFS))}.",
            "pass engine_proof='warn' to be told where the engine does not run as asked, or 'require' to refuse that",
        )
