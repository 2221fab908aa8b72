"""Episodes, or parts of them, that a policy which keeps values is run along side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vlatool.runtime.interface import Array
from vlatool.training.device import on_device

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Lanes:
    """Stretches of rows that are run side by side, each within an episode.

    Args:
        firsts, starts, ends: (L,) first row of each, the first one that counts, and the one after its last.
    """

    firsts: Array
    starts: Array
    ends: Array

    def steps(self) -> Iterator[tuple[Array, Array, Array]]:
        """Yield at each time the rows (L,), in which lanes values are reset before it, and in which a row counts.

        Lanes are as long as the longest: what they run before their first and after their last row does not count.
        """
        lead, length = int((self.starts - self.firsts).max()), int((self.ends - self.starts).max())
        for time in range(-lead, length):
            rows = self.starts + time
            counts = (rows >= self.starts) & (rows < self.ends)
            yield np.clip(rows, self.firsts, self.ends - 1), rows <= self.firsts, counts


def side_by_side(begins: Array, count: int) -> Iterator[Lanes]:
    """Yield all episodes, so many at a time; ``begins`` (N,) says with which rows one begins."""
    firsts = np.flatnonzero(begins)
    ends = np.array([*firsts[1:], len(begins)])
    for start in range(0, len(firsts), count):
        first = firsts[start : start + count]
        yield Lanes(first, first, ends[start : start + count])


def reset(kept: Mapping[str, Tensor], lanes: Array) -> dict[str, Tensor]:
    """Return kept values that are zero in some lanes, (L,) of booleans."""
    return {
        name: value.masked_fill(on_device(lanes).reshape(-1, *[1] * (value.dim() - 1)), 0)
        for name, value in kept.items()
    }
