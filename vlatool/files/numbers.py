"""Numbers that people write in YAML: ``yes`` and ``true`` are none, although Python counts them as 1."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError


class Numeric(BaseModel):
    """Base of models whose numbers are not truth values, alone or in a list or mapping."""

    @field_validator("*", mode="before")
    @classmethod
    def _truth_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        if _has_truth(value) and _numbers_alone(cls.model_fields[info.field_name or ""].annotation):
            raise PydanticCustomError("truth", "Input should be a number, not a truth value")
        return value


def _has_truth(value: Any) -> bool:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else (value,)
    return any(isinstance(part, bool) for part in parts)


def _numbers_alone(annotation: Any) -> bool:
    """Say whether a field takes numbers and no truth values; a model inside of it looks after its own fields."""
    leaves = set(_leaves(annotation))
    return bool(leaves & {int, float}) and not leaves & {bool, Any}


def _leaves(annotation: Any) -> Iterator[Any]:
    parts = [part for part in get_args(annotation) if isinstance(part, type) or get_args(part) or part is Any]
    if not parts:
        yield annotation
    for part in parts:
        yield from _leaves(part)
