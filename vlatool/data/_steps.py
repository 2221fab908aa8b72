"""What a dataset of one step a row holds, and the columns that a person names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.data._recording import Values
from vlatool.errors import DataError
from vlatool.files.limits import check_limit
from vlatool.files.rows import in_memory

Array = NDArray[Any]
PART = re.compile(r"(?P<name>.+?)(?:\[(?P<first>\d{1,9})?(?P<colon>:)?(?P<end>\d{1,9})?\])?")


@dataclass(frozen=True)
class Steps:
    """What a dataset holds, a row for each step of its episodes, which follow each other.

    Args:
        columns: Name -> (N, ...): pictures as recorded, uint8 (height, width, channels); vectors; texts as unicode.
        episodes: (N,) int64, the episode of each row.
        times: (N,) float64 seconds; None where the format has none.
        action: Column of the actions, one for each row; empty where there is none.
        hz: Rate that the dataset names; 0 where it names none.
        tasks: (N,) number of the task of each row; None where the dataset names none.
        stamps: Column -> (N,) seconds at which its values were taken, on the clock of ``times``, where they differ.
        notes: Sentences on what is unusual.
    """

    path: Path
    columns: Mapping[str, Values]
    episodes: Array
    times: Array | None = None
    action: str = ""
    hz: float = 0.0
    tasks: Array | None = None
    stamps: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse columns of different lengths, and none at all."""
        count = len(self.episodes)
        if not count:
            raise DataError(f"{self.path} holds no samples.", "record an episode of one step or more")
        check_limit("recorded_steps", count, str(self.path), DataError)
        lengths = {name: len(values) for name, values in self.columns.items() if len(values) != count}
        if lengths:
            raise DataError(
                f"{self.path} has different numbers of samples: {lengths}; its episodes have {count} steps.",
                "each column needs one row a step",
            )

    def __len__(self) -> int:
        return len(self.episodes)

    def column(self, named: str) -> Values:
        """Return a column, a part of one (``state[0:7]``, ``state[3]``), or several one after the other (``a+b``).

        Raises:
            DataError: when there is none of that name, or parts are taken of what is not a vector.
        """
        if named in self.columns:
            return self.columns[named]
        parts = [self._part(text.strip()) for text in named.split("+")]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def _part(self, text: str) -> Array:
        match = PART.fullmatch(text)
        name = match["name"] if match else text
        if match is None or name not in self.columns:
            raise DataError.unknown(f"{self.path} has no '{name}'", name, self.columns)
        values = self.columns[name]
        if values.ndim > 2 or values.dtype.kind not in "iufb":
            raise DataError(
                f"'{text}' is taken of '{name}' in {self.path}, which is {values.dtype} {list(values.shape)}.",
                "take parts of vectors of numbers alone",
            )
        vector = in_memory(values).reshape(len(values), -1)
        part = vector[:, _slice(match)]
        if not part.shape[1]:
            raise DataError(
                f"'{text}' takes no element of '{name}' in {self.path}, which has {vector.shape[1]}.",
                f"write {name}[FIRST:END], with END no more than {vector.shape[1]}",
            )
        return part


def _slice(match: re.Match[str]) -> slice:
    first, end = (int(match[name]) if match[name] else None for name in ("first", "end"))
    if not match["colon"] and first is not None:
        return slice(first, first + 1)
    return slice(first, end)
