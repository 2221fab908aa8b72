"""Numbers and names for a reader: three significant digits, the unit beside, intervals as precise as their value."""

from __future__ import annotations

import math
import re
import unicodedata
from typing import Any

from vlatool.measures import PERCENT, PLAIN, POINTS, quantity_of
from vlatool.report import COUNT, NO_INTERVAL, Measurement

UNMEASURED_TEXT = "unmeasured"
NARROW_SPACE = "\u202f"
MINUS = "\u2212"
LIMIT_UNITS = {
    "ms": "ms", "s": "s", "mb": "MB", "gb": "GB", "hz": "Hz", "w": "W", "mj": "mJ", "j": "J", "m": "m", "rad": "rad",
    "points": "points", "percent": "%",
}  # fmt: skip


def plain(text: object) -> str:
    """Return text on one line without control characters, so that a name cannot steer a terminal or break a table."""
    if (shown := str(text)).isprintable() and "  " not in shown:
        return shown
    spaced = re.sub(r"[^\S\xa0\u202f]+", " ", shown)
    return "".join(char for char in spaced if unicodedata.category(char) not in ("Cc", "Cf", "Cs", "Co", "Cn"))


def label(name: str) -> str:
    """Return a measurement's name as words: ``latency_p50`` -> ``latency p50``."""
    return plain(quantity_of(name).words)


def decimals_of(value: float, digits: int = 3) -> int:
    """Return the decimals that show ``digits`` significant digits of a number."""
    if value == 0 or not math.isfinite(value):
        return 0
    places = digits - 1 - math.floor(math.log10(abs(value)))
    rounded = round(value, places)
    return max(0, digits - 1 - math.floor(math.log10(abs(rounded))))


def fixed_decimals(value: float, decimals: int) -> str:
    """Return a number with that many decimals, a true minus sign, and thin spaces in thousands from 10 000 on."""
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    rounded = round(value, decimals) + 0.0
    text = f"{abs(rounded):,.{decimals}f}"
    text = text.replace(",", NARROW_SPACE if abs(rounded) >= 10_000 else "")
    return f"{MINUS}{text}" if rounded < 0 else text


def number(value: float, digits: int = 3) -> str:
    """Return a number with ``digits`` significant digits; NaN is ``unmeasured``.

    Example:
        >>> number(0.012345), number(1234.5), number(5)
        ('0.0123', '1234', '5')
    """
    if math.isnan(value):
        return UNMEASURED_TEXT
    if float(value).is_integer() and abs(value) < 1e9:
        return fixed_decimals(value, 0)
    if _scientific(value):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa.replace('-', MINUS)}e{int(exponent)}"
    return fixed_decimals(value, decimals_of(value, digits))


def significant(value: float) -> str:
    """Return a measured number: three significant digits, trailing zeros kept, because they are known."""
    if value == 0 or not math.isfinite(value) or _scientific(value):
        return number(value)
    return fixed_decimals(value, decimals_of(value))


def tick(value: float) -> str:
    """Return a round number without trailing zeros, for an axis."""
    return number(value) if _scientific(value) else f"{value:.10g}".replace("-", MINUS)


def _scientific(value: float) -> bool:
    return math.isfinite(value) and value != 0 and not 1e-4 <= abs(value) < 1e9


def count(samples: int) -> str:
    """Return ``n = 1000``, or nothing when the count is not known."""
    return f"n = {fixed_decimals(samples, 0)}" if samples > 0 else ""


def is_share(measurement: Measurement) -> bool:
    """Return whether a number without a unit is a share of something, to be shown in per cent."""
    form = quantity_of(measurement.name).form
    if measurement.unit != "1" or form == PLAIN:
        return False
    return not measurement.known or abs(measurement.value) <= 1 or form == PERCENT


def is_points(measurement: Measurement) -> bool:
    """Return whether a share is a difference of shares, to be shown in percentage points."""
    return is_share(measurement) and quantity_of(measurement.name).form == POINTS


def _scale(measurement: Measurement) -> tuple[float, str]:
    """Return what the number is multiplied by, and the unit beside it; action errors in metres are in millimetres."""
    if is_share(measurement):
        return 100.0, "points" if is_points(measurement) else "%"
    if measurement.unit == "m" and quantity_of(measurement.name).form == PLAIN:
        return 1000.0, "mm"
    return 1.0, {"1": "", COUNT: "", "x": "×", "degC": "°C"}.get(measurement.unit, plain(measurement.unit))


def unit(measurement: Measurement) -> str:
    """Return the unit as it is printed beside the number."""
    return _scale(measurement)[1]


def _decimals(measurement: Measurement, value: float) -> int:
    if not is_share(measurement):
        return decimals_of(value) if value else decimals_of(measurement.high or 0.0)
    edge = 100.0 if abs(value) > 50 else 0.0
    decimals = 1 if is_points(measurement) or abs(value) >= 1 or value == 0 else min(4, decimals_of(value, 2))
    while decimals < 4 and abs(value) != edge and round(abs(value), decimals) == edge:
        decimals += 1
    return decimals


def value(measurement: Measurement) -> str:
    """Return the number without its unit, shares in per cent."""
    if not measurement.known:
        return UNMEASURED_TEXT
    shown = measurement.value * _scale(measurement)[0]
    if not is_share(measurement) and _scientific(shown):
        return number(shown)
    return fixed_decimals(shown, _decimals(measurement, shown) if shown or is_share(measurement) else 0)


def interval(measurement: Measurement) -> str:
    """Return ``97.4–99.0``, ``≤ 99.0`` or ``≥ 97.4``, in the unit and with the decimals of the value.

    Nothing when there is no bound.
    """
    if not measurement.known:
        return ""
    factor = _scale(measurement)[0]
    decimals = _decimals(measurement, measurement.value * factor)
    low, high = (None if bound is None else bound * factor for bound in (measurement.low, measurement.high))
    if low is None or high is None:
        alone = ((sign, bound) for sign, bound in (("≥", low), ("≤", high)) if bound is not None)
        return "".join(f"{sign} {fixed_decimals(bound, decimals)}" for sign, bound in alone)
    while decimals < 6 and low != high and round(low, decimals) == round(high, decimals):
        decimals += 1
    rough = _scientific(measurement.value * factor) or math.isinf(low) or math.isinf(high)
    ends = [
        number(end) if rough and not is_share(measurement) else fixed_decimals(end, decimals) for end in (low, high)
    ]
    return " to ".join(ends) if low < 0 else "–".join(ends)


def is_usual(measurement: Measurement) -> bool:
    """Return whether the interval covers the usual 95 %, so that it needs no mark."""
    return abs(measurement.confidence - 0.95) < 1e-9


def span(measurement: Measurement) -> str:
    """Return the interval, marked with its coverage when that is not 95 %; or, where the note says it, why none is."""
    ends = interval(measurement)
    if not ends:
        return next((plain(part) for part in measurement.note.split("; ") if part.startswith(NO_INTERVAL)), "")
    return ends if is_usual(measurement) else f"{number(measurement.confidence * 100)} %: {ends}"


def bracket_text(measurement: Measurement) -> str:
    """Return what stands in brackets behind a number: interval and count."""
    return ", ".join(part for part in (span(measurement), count(measurement.samples)) if part)


def quantity(measurement: Measurement) -> str:
    """Return the number with its unit, or ``unmeasured``."""
    text, beside = value(measurement), unit(measurement)
    if not measurement.known or not beside:
        return text
    return text + beside if beside == "×" else f"{text} {beside}"


def full(measurement: Measurement) -> str:
    """Return the number with everything that qualifies it.

    Example:
        >>> full(Measurement("success", 0.984, "1", samples=1000, low=0.974, high=0.99))
        '98.4 % (97.4–99.0, n = 1000)'
    """
    if not measurement.known:
        return f"{UNMEASURED_TEXT}: {plain(measurement.note)}" if measurement.note else UNMEASURED_TEXT
    brackets = bracket_text(measurement)
    return f"{quantity(measurement)} ({brackets})" if brackets else quantity(measurement)


def limit(name: str, value: Any) -> tuple[str, str]:
    """Return a limit's name as words and its value with the unit that ends the name."""
    if name == "hz":
        return "rate", f"{cell(value)} Hz"
    words, _, last = name.rpartition("_")
    if words and last in LIMIT_UNITS:
        unit = "point" if last == "points" and value == 1 else LIMIT_UNITS[last]
        return plain(words.replace("_", " ")), f"{cell(value)} {unit}"
    return plain(name.replace("_", " ")), cell(value)


def cell(content: Any) -> str:
    """Return a cell of a details table, or a fact of the environment, as text."""
    if content is None:
        return "–"
    if isinstance(content, bool):
        return "yes" if content else "no"
    if isinstance(content, float):
        whole = 1e4 <= abs(content) < 1e7
        return "–" if math.isnan(content) else (f"{content:,.0f}" if whole else f"{content:.4g}").replace("-", MINUS)
    if isinstance(content, list | tuple):
        return ", ".join(cell(item) for item in content)
    return plain(content)
