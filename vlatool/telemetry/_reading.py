"""Readings with units, or the reason why there are none; base classes of readers.

A reading that cannot be taken is left out; it is never 0 and never NaN.
"""

from __future__ import annotations

import math
import re
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, TypeVar

from vlatool.machine.host import ROOT, read_number

R = TypeVar("R", bound="Reader")
Kind = Literal["gauge", "counter"]
Run = Callable[[Sequence[str]], "str | None"]
"""Runs a command and returns what it printed; None when it is absent, fails or takes too long."""

WATT = "W"
JOULE = "J"
DEGREE = "degC"
MEGAHERTZ = "MHz"
MEGABYTE = "MB"
SECOND = "s"
SHARE = "share"
COUNT = "count"
THROTTLE = "throttle"
"""Unit of throttling. Counter: throttle events. Gauge: 1 while the machine is throttled for this reason, else 0."""
MIN_TEMPERATURE = -200.0
"""Temperature in degC below which a thermal zone is powered off: Jetsons show -256."""
COMMAND_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class Reading:
    """One value at one moment.

    Args:
        name: Reader and thing, ``ina.VDD_IN``.
        value: A finite number in ``unit``.
        unit: ``W``, ``J``, ``degC``, ``MHz``, ``MB`` (10^6 bytes), ``s``, ``share`` (0 to 1), ``count``, ``throttle``.
        kind: ``gauge``: the value is meaningful. ``counter``: only differences are meaningful.
        wraps: Value at which a counter restarts from zero; None when it does not.
        note: Description of the value, where the name does not suffice.

    Raises:
        ValueError: when the value is not finite.
    """

    name: str
    value: float
    unit: str
    kind: Kind
    wraps: float | None = None
    note: str = ""

    def __post_init__(self) -> None:
        if not math.isfinite(self.value):
            raise ValueError(f"the reading '{self.name}' must be finite, got {self.value}")


@dataclass(frozen=True)
class Absent:
    """An unmeasured source or reading.

    Args:
        reader: Name of the reader, or of the reading.
        reason: Why it cannot be read and what to do about it.
        other_board: Whether this kind of machine does not have the source.
    """

    reader: str
    reason: str
    other_board: bool = False


class Reader(ABC):
    """Reads one source of telemetry; one class in one file, found by its file name."""

    name: ClassVar[str]
    period_s: ClassVar[float] = 0.0
    """Least seconds between two reads: a reader that starts a process would disturb the measurement."""
    fallback_for: ClassVar[str] = ""
    """Name of the reader that this one replaces when it is absent."""

    @classmethod
    @abstractmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> Reader | Absent:
        """Return a reader of the machine whose file system is below ``root``, or why there is none.

        ``run`` runs commands. By default commands run on this machine, and not at all for another root.
        """

    @abstractmethod
    def read(self) -> list[Reading]:
        """Return the readings that are available now, fewer when something fails. Never raises."""

    def absent(self) -> list[Absent]:
        """Return missing parts of this source."""
        return []

    def or_absent(self: R, reason: str, *, other_board: bool = False) -> R | Absent:
        """Return this reader, or an ``Absent`` with these fields when it reads nothing."""
        return self if self.read() else Absent(self.name, reason, other_board)


@dataclass(frozen=True)
class NumberFile:
    """A file that holds one integer.

    Args:
        name, unit, kind, wraps, note: Fields of the reading.
        path: Path relative to the root of the file system.
        factor: Factor from the number to the unit.
        minimum: Smallest meaningful value.
    """

    name: str
    path: str
    factor: float
    unit: str
    kind: Kind = "gauge"
    wraps: float | None = None
    note: str = ""
    minimum: float = -math.inf


class FileReader(Reader):
    """Reads files that hold one number each."""

    def __init__(self, root: Path, files: Iterable[NumberFile]) -> None:
        self._root = root
        self._files = tuple(files)

    def read(self) -> list[Reading]:
        """Return a reading of every file that can be read now."""
        values = [(file, number(self._root, file.path, file.factor)) for file in self._files]
        return [
            Reading(file.name, value, file.unit, file.kind, file.wraps, file.note)
            for file, value in values
            if value is not None and value >= file.minimum
        ]


class CommandReader(Reader):
    """Reads what a command prints."""

    def __init__(self, run: Run) -> None:
        self._run = run


def gauge(name: str, value: float | None, unit: str, note: str = "", kind: Kind = "gauge") -> list[Reading]:
    """Return one gauge; an empty list without a finite value."""
    return [] if value is None or not math.isfinite(value) else [Reading(name, value, unit, kind, note=note)]


def counter(name: str, value: float | None, unit: str, note: str = "") -> list[Reading]:
    """Return one counter; an empty list without a finite value."""
    return gauge(name, value, unit, note, "counter")


def number(root: Path, path: str, factor: float) -> float | None:
    """Return the integer in a file, times ``factor``; None when there is none."""
    try:
        number = read_number(root, path)
        return None if number is None else number * factor
    except (ValueError, OverflowError):  # thousands of digits
        return None


def find(root: Path, folder: str, pattern: str) -> list[str]:
    """Return the entries of a folder that match, relative to ``root``; ``hwmon2`` comes before ``hwmon10``."""
    try:
        paths = [path.relative_to(root).as_posix() for path in (root / folder).glob(pattern)]
    except OSError:
        return []
    return sorted(
        paths, key=lambda path: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path)]
    )


def run_command(command: Sequence[str]) -> str | None:
    """Run a command on this machine for at most two seconds and return its output; None when it fails."""
    try:
        done = subprocess.run(
            list(command), stdin=subprocess.DEVNULL, capture_output=True, timeout=COMMAND_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode("utf-8", "replace") if done.returncode == 0 else None


def runner(root: Path, run: Run | None) -> Run:
    """Return the function that runs commands for ``root``: ``run``, or this machine for its own root, or none."""
    if run is not None:
        return run
    return run_command if root == ROOT else lambda command: None
