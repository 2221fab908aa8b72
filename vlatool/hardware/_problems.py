"""Problems of a profile: one line for each field."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from vlatool.errors import suggest
from vlatool.files.printable import reason_of

UNITS = ("cpu", "gpu", "npu")
WEIGHTS = ("w8", "w4")
"""Weights alone in few bits; they are computed with in float16 or float32."""
REASONS = {
    "missing": "is missing",
    "model_type": "must be a mapping",
    "dict_type": "must be a mapping",
    "too_short": "needs at least one entry",
    "float_parsing": "must be a number",
    "string_pattern_mismatch": "must be lower-case letters, digits and hyphens",
}


def describe_problem(error: ErrorDetails, known: Iterable[str]) -> str:
    """Return ``field: what is wrong`` for one finding of pydantic."""
    kind, got = error["type"], f"; got {error['input']!r}"
    where = ".".join(str(part) for part in error["loc"] if part != "[key]")
    if kind == "extra_forbidden":
        hint, _, _ = suggest(str(error["loc"][-1]), known).rpartition(" known: ")
        return f"{where}: is not a known key; {hint}".removesuffix("; ")
    if kind == "value_error":
        return f"{where}: {reason_of(error['msg'])}"
    words = error["msg"].replace("Input should be", "must be").replace("greater than 0", "above 0")
    return f"{where}: {REASONS.get(kind, words)}{'' if kind == 'missing' else got}"


def source_problems(value: Any, sources: Mapping[str, str], where: str = "") -> Iterator[str]:
    """Yield a problem for each figure below ``value`` whose source is not listed."""
    if isinstance(value, BaseModel):
        source = getattr(value, "source", None)
        if source is not None and source not in sources:
            yield f"{where}source: '{source}' is not in sources; {suggest(source, sources)}"
        value = dict(value)
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, tuple) else ()
    for key, item in items:
        yield from source_problems(item, sources, f"{where}{key}.")


def name_problems(profile: Any) -> Iterator[str]:
    """Yield a problem for each reference to a unit or mode that does not exist."""
    for unit_name in set(profile.units) - set(UNITS):
        yield f"units.{unit_name}: is not a kind of unit; {suggest(unit_name, UNITS)}"
    if profile.default_mode not in profile.modes:
        yield f"default_mode: '{profile.default_mode}' is not in modes; {suggest(profile.default_mode, profile.modes)}"
    for name, engine in profile.engines.items():
        if engine.unit not in profile.units:
            yield f"engines.{name}.unit: '{engine.unit}' is not in units; {suggest(engine.unit, profile.units)}"
            continue
        peaks = profile.units[engine.unit].peak_tops
        for dtype in engine.dtypes:
            if dtype not in WEIGHTS and dtype not in peaks:
                yield f"engines.{name}.dtypes: {engine.unit} has no peak_tops.{dtype}"
            elif dtype in WEIGHTS and not {"float16", "float32"} & set(peaks):
                yield f"engines.{name}.dtypes: {dtype} needs a peak_tops.float16 or float32 of {engine.unit}"
    for release in profile.software:
        for engine_name in {*release.engines} - {*profile.engines}:
            yield f"software.{release.release}.engines: '{engine_name}' is not in engines; " + suggest(
                engine_name, profile.engines
            )
    for name, mode in profile.modes.items():
        for unit in {*mode.cores, *mode.clock_mhz} - {*profile.units}:
            yield f"modes.{name}: '{unit}' is not in units; {suggest(unit, profile.units)}"
