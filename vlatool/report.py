"""Measurements with units, raw samples kept, and the report that holds them. JSON with a versioned schema."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

from vlatool.errors import DataError
from vlatool.files.messages import Number, from_json, to_json

SCHEMA = 1
REPORT = "report.json"
ON_BOARD = "is_profile"
"""Key of the environment: the profile that the machine is the board of."""
COUNT = "count"
"""Unit of a number of things, which may be a mean of such numbers; ``1`` is a share."""
NO_INTERVAL = "no interval: "
"""What the part of a note begins with that says why a number that usually has an interval has none."""
ORIGINS = ("measured", "predicted")
VERDICTS = ("pass", "fail", "inconclusive", "info")
ROLES = ("baseline", "chosen", "within", "outside", "failed", "subject")
VALIDITIES = ("", "valid", "suspect", "invalid")
EFFECTS = ("note", "suspect", "invalid")


@dataclass(frozen=True)
class Measurement:
    """One number, and what it is.

    Args:
        name: The quantity (``vlatool.measures``), for example ``latency_p50``.
        value: The number; NaN when it could not be had (then ``note`` says why).
        unit: ``ms``, ``MB``, ``1`` (a share), ``count`` (a number of things), ``x`` (a ratio), the unit of an action
            element, or nothing where there is none.
        origin: ``measured`` (on ``where``) or ``predicted`` (for ``where``).
        where: The host, or the profile.
        samples: How many observations the number rests on.
        low, high: Bounds of the interval, None when there is none.
        confidence: Coverage of the interval, 0-1.
        note: Method, model or reservation in a few words.
    """

    name: str
    value: Number
    unit: str
    origin: str = "measured"
    where: str = "this host"
    samples: int = 0
    low: Number | None = None
    high: Number | None = None
    confidence: Number = 0.95
    note: str = ""

    def __post_init__(self) -> None:
        if self.origin not in ORIGINS:
            raise ValueError(f"origin is {self.origin!r}; allowed: {', '.join(ORIGINS)}")
        if not isinstance(self.value, int | float):
            raise ValueError(f"the value of {self.name} is {self.value!r}; allowed: a number")

    @property
    def known(self) -> bool:
        """False when the number could not be had."""
        return not math.isnan(self.value)


class HasName(Protocol):
    """What has the name of a quantity: one of ``vlatool.measures``, or a measurement of it."""

    @property
    def name(self) -> str:
        """The name in reports."""
        ...


@dataclass(frozen=True)
class Row:
    """One policy variant in a report.

    Args:
        name: Name of the variant, for example ``static_int8``.
        role: ``baseline``, ``chosen``, ``within`` or ``outside`` the limits, ``failed``, or ``subject``.
        reason: Why it has this role, in words.
        measurements: Measurements in no particular order; names are unique within a row and origin.
        raw: Series name (``vlatool.measures.series``) -> raw samples in the order in which they were taken; NaN where
            one is not known.
        details: Tables that belong to the row: title (``vlatool.measures.tables``) -> list of {column: cell}.
    """

    name: str
    role: str = "subject"
    reason: str = ""
    measurements: tuple[Measurement, ...] = ()
    raw: Mapping[str, list[Number]] = field(default_factory=dict)
    details: Mapping[str, list[dict[str, Any]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise ValueError(f"role is {self.role!r}; allowed: {', '.join(ROLES)}")
        if not isinstance(self.raw, Mapping) or not isinstance(self.details, Mapping):
            raise ValueError(f"raw and details of {self.name} must be mappings")

    def get(self, quantity: HasName, origin: str = "measured") -> Measurement | None:
        """Return the measurement of a quantity and origin, or None; a script may give the name of the quantity."""
        name = getattr(quantity, "name", quantity)
        return next((item for item in self.measurements if (item.name, item.origin) == (name, origin)), None)

    def value(self, quantity: HasName) -> float:
        """Return a measured value, NaN when it is not there."""
        measurement = self.get(quantity)
        return measurement.value if measurement else math.nan


@dataclass(frozen=True)
class Finding:
    """What was seen that bears on whether the measurement can be trusted.

    Args:
        effect: ``invalid`` (the numbers must not be used), ``suspect`` (they may be wrong) or ``note``.
        reason: What was seen, with its numbers.
        remedy: What to do about it; empty when there is nothing to do.
    """

    effect: str
    reason: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if self.effect not in EFFECTS:
            raise ValueError(f"effect is {self.effect!r}; allowed: {', '.join(EFFECTS)}")
        if not isinstance(self.reason, str) or not isinstance(self.remedy, str):
            raise ValueError(f"reason and remedy are {self.reason!r} and {self.remedy!r}; allowed: text")


@dataclass(frozen=True)
class Report:
    """What a command measured, predicted and decided.

    Args:
        kind: ``benchmark``, ``evaluate``, ``optimize``, ``compare``, ``hwselect``, ``gate`` or
            ``training``.
        title: One line.
        verdict: ``pass``, ``fail``, ``inconclusive`` or ``info``.
        summary: Sentences for a person; the first is the result.
        rows: The variants, baseline first.
        limits: Limit name -> the value that was asked for, with its unit in the name.
        command: The command line that made the report.
        created: UTC time, ISO 8601.
        environment: The machine, its state and the versions (see ``vlatool.machine.host``).
        warnings: What a reader should know before trusting the numbers, with the remedy.
        schema: Version of this format.
        validity: Whether the measurement can be trusted: ``valid``, ``suspect``, ``invalid``; empty when not judged.
        findings: Why, each with its remedy.
    """

    kind: str
    title: str
    verdict: str = "info"
    summary: tuple[str, ...] = ()
    rows: tuple[Row, ...] = ()
    limits: Mapping[str, Any] = field(default_factory=dict)
    command: str = ""
    created: str = ""
    environment: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    schema: int = SCHEMA
    validity: str = ""
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"verdict is {self.verdict!r}; allowed: {', '.join(VERDICTS)}")
        if self.validity not in VALIDITIES:
            raise ValueError(f"validity is {self.validity!r}; allowed: {', '.join(VALIDITIES)}")

    def to_json(self) -> str:
        """Return JSON; NaN is written as null."""
        return json.dumps(without_nan(to_json(self)), indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Report:
        """Read what ``to_json`` wrote; raises DataError when the text is not a report, or of a newer schema."""
        try:
            data = json.loads(text)
            if data["schema"] > SCHEMA:
                raise DataError(
                    f"The report has the schema {data['schema']}; this vlatool reads up to {SCHEMA}.", "upgrade vlatool"
                )
            known = {item.name for item in fields(cls)}
            return from_json(cls, {key: item for key, item in data.items() if key in known}, "report")
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise DataError(
                f"This is not a vlatool report: {error}.", "name a report.json that vlatool wrote, or measure again"
            ) from error


def read_report(path: Path) -> Report:
    """Read a report file, or ``[reports/]report.json`` of a directory; raises DataError when none can be read."""
    for candidate in (path, path / REPORT, path / "reports" / REPORT):
        if candidate.is_file():
            try:
                return Report.from_json(candidate.read_text(encoding="utf-8"))
            except (OSError, UnicodeDecodeError) as error:
                raise DataError(
                    f"The report {candidate} cannot be read: {error}.",
                    "check that the file is there and readable, or measure again",
                ) from error
    raise DataError(f"No report at {path}.", "name a report.json, or a directory that holds one")


def without_nan(value: Any) -> Any:
    """Return a value that JSON can say: NaN and the infinities are null, tuples, arrays and their numbers are plain."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return value
