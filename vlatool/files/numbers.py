"""Numbers in YAML: ``yes`` and ``true`` are not numbers, although Python treats True as 1."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError


class Numeric(BaseModel):
    """Base of models whose numbers are not truth values, alone or in a list or mapping."""

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans(cls, value: Any, info: ValidationInfo) -> Any:
        if _has_boolean(value) and _takes_only_numbers(cls.model_fields[info.field_name or ""].annotation):
            raise PydanticCustomError("truth", "Input should be a number, not a truth value")
        return value


def _has_boolean(value: Any) -> bool:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else (value,)
    return any(isinstance(part, bool) for part in parts)


def _takes_only_numbers(annotation: Any) -> bool:
    """Return whether a field takes numbers and no truth values; a nested model checks its own fields."""
    leaves = set(_leaves(annotation))
    return bool(leaves & {int, float}) and not leaves & {bool, Any}


def _leaves(annotation: Any) -> Iterator[Any]:
    parts = [part for part in get_args(annotation) if isinstance(part, type) or get_args(part) or part is Any]
    if not parts:
        yield annotation
    for part in parts:
        yield from _leaves(part)
