"""Columns of parquet files: numbers and texts in memory, pictures read when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.data._pictures import decode_picture, library_errors, stack_pictures
from vlatool.errors import DataError, require

Array = NDArray[Any]
BATCH_ROWS, PICTURE_ROWS = 8192, 4
"""Rows that are decoded at a time: of numbers, and of pictures."""
COPY_AGAIN = "copy the dataset again, or record it again"


@dataclass(frozen=True)
class Table:
    """Some columns of one parquet file, all rows in memory.

    Args:
        columns: name -> (N, ...) numbers, or N texts.
    """

    path: Path
    rows: int
    columns: dict[str, Array]

    def __getitem__(self, name: str) -> Array:
        if name not in self.columns:
            raise DataError(f"{self.path} has no column '{name}'.", COPY_AGAIN)
        return self.columns[name]


def open_parquet(path: Path) -> Any:
    """Open a parquet file; its footer is read.

    Raises:
        DataError: when it is missing or corrupt.
        MissingExtra: when pyarrow is not installed.
    """
    library: Any = require("pyarrow.parquet", "data")
    if not path.is_file():
        raise DataError(f"{path} not found.", COPY_AGAIN)
    with library_errors(str(path), COPY_AGAIN):
        return library.ParquetFile(str(path))


def read_table(path: Path, names: Sequence[str] | None = None) -> Table:
    """Read columns of numbers and texts; those that a file does not have are left out.

    Args:
        names: names of columns; all when None.

    Raises:
        DataError: when the file is corrupt, or a list has another length in another row.
    """
    file = open_parquet(path)
    with library_errors(str(path), COPY_AGAIN):
        present = [name for name in file.schema_arrow.names if names is None or name in names]
        parts: dict[str, list[Array]] = {name: [] for name in present}
        for batch in file.iter_batches(BATCH_ROWS, columns=present):
            for name in present:
                parts[name].append(_values(batch.column(name), f"'{name}' in {path}"))
        columns = {name: _concatenated(blocks, f"'{name}' in {path}") for name, blocks in parts.items()}
        return Table(path, file.metadata.num_rows, columns)


def _concatenated(blocks: list[Array], where: str) -> Array:
    if len({block.shape[1:] for block in blocks}) > 1:
        raise DataError(f"{where} has rows of different lengths.", COPY_AGAIN)
    return np.concatenate(blocks) if blocks else np.empty(0)


def _values(column: Any, where: str) -> Array:
    """Return a column of scalars, of lists of one length, or of texts as an array."""
    types = require("pyarrow", "data").types
    if isinstance(column, require("pyarrow", "data").ExtensionArray):
        column = column.storage
    rows, shape = len(column), [len(column)]
    while types.is_list(column.type) or types.is_large_list(column.type) or types.is_fixed_size_list(column.type):
        lengths = np.unique(column.value_lengths().to_numpy(zero_copy_only=False)) if len(column) else np.zeros(1)
        if len(lengths) != 1 or not np.isfinite(lengths[0]):
            raise DataError(f"{where} has rows of different lengths.", COPY_AGAIN)
        shape.append(int(lengths[0]))
        column = column.flatten()
    values = column.to_numpy(zero_copy_only=False)
    if values.dtype == object:
        return _texts(values, where)
    return np.asarray(values).reshape(shape) if rows else np.asarray(values)


def _texts(values: Array, where: str) -> Array:
    if not all(isinstance(value, str) for value in values.ravel().tolist()):
        raise DataError(f"{where} is neither numbers nor text.", COPY_AGAIN)
    return values.astype(str)


class ParquetPictures:
    """Compressed pictures in a column of parquet files: {bytes, path}, or the bytes themselves.

    Args:
        files: files in the order of their rows.
        counts: number of rows of each file.
        folder: where a picture is that a row names instead of holding it.
    """

    def __init__(self, files: Sequence[Path], counts: Sequence[int], column: str, folder: Path) -> None:
        self._files, self._column, self._folder = files, column, folder
        self._ends = np.cumsum(counts)
        self._next = (-1, -1)
        self._iterator: Iterator[bytes] = iter(())

    def fetch(self, rows: NDArray[np.intp]) -> Array:
        """Return the pictures of some rows, (n, height, width, channels).

        Raises:
            DataError: when one cannot be read, or they differ in size.
        """
        pictures = [decode_picture(self._content(int(row)), self._where(int(row))) for row in rows]
        return stack_pictures(pictures, f"'{self._column}' in {self._folder}", rows)

    def _where(self, row: int) -> str:
        return f"'{self._column}' in row {row} of the dataset ({self._files[self._file_of(row)]})"

    def _file_of(self, row: int) -> int:
        return int(np.searchsorted(self._ends, row, side="right"))

    def _content(self, row: int) -> bytes:
        """Return a compressed picture; the next one of the same file is read on from there."""
        file, following = self._next
        if file != self._file_of(row) or not following <= row < following + BATCH_ROWS:
            file, following, self._iterator = self._file_of(row), row, self._start(row)
        with library_errors(self._where(row), COPY_AGAIN):
            for content in self._iterator:
                following += 1
                self._next = (file, following)
                if following > row:
                    return content
        raise DataError(f"{self._where(row)} is missing.", COPY_AGAIN)

    def _start(self, row: int) -> Iterator[bytes]:
        """Yield the pictures of a file from a row on, a few at a time."""
        at = self._file_of(row)
        inside = row - (int(self._ends[at - 1]) if at else 0)
        file = open_parquet(self._files[at])
        for group in range(file.metadata.num_row_groups):
            size = file.metadata.row_group(group).num_rows
            if inside < size:
                yield from self._of_group(file, group, inside)
            inside = max(0, inside - size)

    def _of_group(self, file: Any, group: int, first: int) -> Iterator[bytes]:
        for batch in file.iter_batches(PICTURE_ROWS, row_groups=[group], columns=[self._column]):
            cells = batch.column(self._column)
            if first >= len(cells):
                first -= len(cells)
                continue
            yield from (self._bytes(cell.as_py()) for cell in cells[first:])
            first = 0

    def _bytes(self, cell: Any) -> bytes:
        content = cell.get("bytes") if isinstance(cell, dict) else cell
        if isinstance(content, bytes):
            return content
        named = cell.get("path") if isinstance(cell, dict) else None
        file = (self._folder / str(named or "")).resolve()
        if not named or not file.is_relative_to(self._folder.resolve()) or not file.is_file():
            raise DataError(f"'{self._column}' in {self._files[0]} names the picture {named!r}, which is not there.",
                            COPY_AGAIN)  # fmt: skip
        return file.read_bytes()
