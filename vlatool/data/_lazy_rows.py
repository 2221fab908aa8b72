"""Rows that are computed when they are read: decoded frames, texts of a table, windows of actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError
from vlatool.files.rows import Rows

Array = NDArray[Any]
Fetch = Callable[[NDArray[np.intp]], Array]
"""Indices of rows -> their values, (number of indices, ...)."""


class LazyRows(Rows):
    """An array whose rows are fetched when they are read, and not cached.

    Args:
        fetch: indices of rows, in any order -> their values.
        shape: shape, with the axis of rows first.
        where: the array in messages.
        indices: index of each row for ``fetch``; 0, 1, ... when None.
        limit: type whose largest number no value may exceed; None where any value is allowed.

    Example:
        >>> rows = LazyRows(lambda indices: indices[:, None] * 2.0, (4, 1), np.dtype(np.float64), "doubles")
        >>> rows.select(np.array([False, True, True, False])).read(0, 2).tolist()
        [[2.0], [4.0]]
    """

    def __init__(
        self, fetch: Fetch, shape: tuple[int, ...], dtype: np.dtype[Any], where: str,
        indices: NDArray[np.intp] | None = None, limit: np.dtype[Any] | None = None
    ) -> None:  # fmt: skip
        self._fetch, self._indices, self._limit = fetch, indices, limit
        self.shape = shape
        self.dtype = dtype
        self.where = where

    def __getitem__(self, at: int | Sequence[int]) -> Array:
        """Return one row, or the rows at several indices, as an array in memory.

        Raises:
            IndexError: when an index is out of range.
            DataError: when a row cannot be read.
        """
        if isinstance(at, int | np.integer):
            row: Array = self.read(range(len(self))[at], 1)[0]
            return row
        return self._values(np.asarray([range(len(self))[index] for index in at], np.intp))

    def read(self, first: int, count: int) -> Array:
        """Return ``count`` rows from ``first`` on.

        Raises:
            DataError: when a row cannot be read.
        """
        return self._values(np.arange(first, first + count))

    def select(self, chosen: NDArray[np.bool_]) -> LazyRows:
        """Return the rows of a mask, read later, too.

        Args:
            chosen: (N,) mask of the rows.
        """
        return self.at(np.flatnonzero(chosen))

    def at(self, indices: NDArray[np.intp]) -> LazyRows:
        """Return the rows at some indices, read later, too."""
        own = indices if self._indices is None else self._indices[indices]
        return LazyRows(self._fetch, (len(own), *self.shape[1:]), self.dtype, self.where, own, self._limit)

    def without_second_axis(self) -> LazyRows:
        """Return the same rows without their second axis, which has one element."""

        def fetch(indices: NDArray[np.intp]) -> Array:
            return self._fetch(indices)[:, 0]

        return LazyRows(fetch, (self.shape[0], *self.shape[2:]), self.dtype, self.where, self._indices, self._limit)

    def within(self, limit: np.dtype[Any]) -> LazyRows:
        """Return the same rows, of which each must be finite in a type of floats once it is read."""
        return LazyRows(self._fetch, self.shape, self.dtype, self.where, self._indices, limit)

    def _values(self, rows: NDArray[np.intp]) -> Array:
        if not len(rows):
            return np.empty((0, *self.shape[1:]), self.dtype)
        values = self._fetch(rows if self._indices is None else self._indices[rows])
        if values.shape != (len(rows), *self.shape[1:]):
            raise DataError(
                f"{self.where} has the shape {list(values.shape[1:])} in sample {int(rows[0])}; wanted "
                f"{list(self.shape[1:])}, as in the first.",
                "record each sample in one shape",
            )
        if self._limit is not None:
            self._check(rows, values, self._limit)
        return values.astype(self.dtype, copy=False)

    def _check(self, rows: NDArray[np.intp], values: Array, limit: np.dtype[Any]) -> None:
        with np.errstate(over="ignore"):
            wrong = ~np.isfinite(values.astype(limit, copy=False).reshape(len(rows), -1)).all(axis=1)
        if wrong.any():
            raise DataError(
                f"{self.where} is not finite in {limit} in sample {int(rows[int(wrong.argmax())])}.",
                "remove that sample, or repair the recording",
            )


def text_rows(texts: Sequence[str], numbers: NDArray[Any], where: str) -> LazyRows:
    """Return a text for each row, of a table of texts.

    Args:
        numbers: (N,) index in ``texts`` of each row.

    Example:
        >>> text_rows(["go", "stay"], np.array([1, 0]), "task").read(0, 2).tolist()
        ['stay', 'go']
    """
    table = np.array(texts or [""])
    return LazyRows(lambda rows: table[numbers[rows]], (len(numbers),), table.dtype, where)
