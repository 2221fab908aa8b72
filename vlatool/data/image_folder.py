"""A folder of pictures with a CSV file: a line for each step, pictures by name, numbers in columns."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.data._lazy_rows import LazyRows
from vlatool.data._pictures import SUFFIXES, decode_picture, library_errors, stack_pictures
from vlatool.data._recording import Values
from vlatool.data._step_reader import StepReader
from vlatool.data._steps import Steps
from vlatool.errors import DataError
from vlatool.files.limits import check_limit
from vlatool.files.printable import amount
from vlatool.registry import Claim

Array = NDArray[Any]
EPISODE = ("episode", "episode_index", "episode_id")
TIME = ("timestamp", "time", "t", "stamp")
TASK = ("task", "instruction", "language_instruction")
ELEMENT = re.compile(r"(?P<name>.*?)(?:[._](?P<at>\d+)|\[(?P<index>\d+)\])")
"""An element of a vector: ``state.0``, ``state_0``, ``state[0]``."""
CORRECT = "correct that line of the CSV file"


class ImageFolder(StepReader):
    """Reads a CSV file, or the only one of a folder, with the pictures that it names."""

    suffix: ClassVar[str] = ".csv"
    needs: ClassVar[str] = "a .csv file, or a folder with one and the pictures that it names"

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Claim a CSV file, and perhaps a folder that holds one."""
        if path.is_dir():
            return Claim.MAYBE if any(path.glob("*.csv")) else Claim.NONE
        return super().claims(path)

    def steps(self, path: Path) -> Steps:
        """Return what the lines of a CSV file say.

        Raises:
            DataError: when it is not a table, or names what is not a number or not a picture of the folder.
        """
        file = _csv_file(path)
        header, lines = _read(file)
        cells = {name: [line[at] for line in lines] for at, name in enumerate(header)}
        episode, time, task = (next((name for name in names if name in cells), "") for names in (EPISODE, TIME, TASK))
        episodes = _whole(file, episode, cells[episode]) if episode else np.zeros(len(lines), np.int64)
        if len(np.unique(episodes)) != 1 + np.count_nonzero(np.diff(episodes)):
            raise DataError(
                f"'{episode}' in {file} comes back to an episode that had ended.", "sort its lines by episode"
            )
        times = _numbers(file, time, cells[time]) if time else None
        pictures = [name for name in header if cells[name][0].lower().endswith(SUFFIXES)]
        columns: dict[str, Values] = {name: _pictures(file, name, cells[name]) for name in pictures}
        texts = [name for name in header if name == task or (name not in pictures and not _is_number(cells[name][0]))]
        columns |= {name: np.array(cells[name]) for name in texts}
        rest = [name for name in header if name not in (*pictures, *texts, episode, time)]
        columns |= _vectors(file, {name: _numbers(file, name, cells[name]) for name in rest})
        tasks = np.unique(cells[task], return_inverse=True)[1] if task else None
        return Steps(path, columns, episodes, times, "action" if "action" in columns else "", tasks=tasks)


def _csv_file(path: Path) -> Path:
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    if len(files) != 1:
        raise DataError(f"{path} holds {len(files)} CSV files: {', '.join(file.name for file in files[:6])}.",
                        "name the one that is meant")  # fmt: skip
    return files[0]


def _read(file: Path) -> tuple[list[str], list[list[str]]]:
    """Return the names of the columns, and the cells of each line."""
    with library_errors(str(file), CORRECT), file.open(encoding="utf-8-sig", newline="") as stream:
        try:
            rows = [row for row in csv.reader(stream, strict=True) if row]
        except csv.Error as error:
            raise DataError(f"{file} is not a CSV file: {error}.", CORRECT) from error
    if len(rows) < 2:
        raise DataError(f"{file} holds no samples.", "write the names of the columns, and a line for each step")
    header = [name.strip() for name in rows[0]]
    if "" in header or len({*header}) < len(header):
        raise DataError(f"{file} has a column without a name, or two of one name: {header}.", CORRECT)
    check_limit("recorded_steps", len(rows) - 1, str(file), DataError)
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise DataError(
                f"{file}, line {number}, has {amount(len(row), 'cell')}; it has {amount(len(header), 'column')}.",
                CORRECT,
            )
    return header, rows[1:]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(file: Path, name: str, cells: Sequence[str]) -> Array:
    try:
        return np.array(cells).astype(np.float64)
    except ValueError:
        line = next(number for number, cell in enumerate(cells, 2) if not _is_number(cell))
        raise DataError(
            f"'{name}' in {file}, line {line}, is '{cells[line - 2][:40]}', not a number.", CORRECT
        ) from None


def _whole(file: Path, name: str, cells: Sequence[str]) -> Array:
    values = _numbers(file, name, cells)
    if not np.isfinite(values).all() or (values % 1).any() or np.abs(values).max() > 1e15:
        raise DataError(f"'{name}' in {file} must be whole numbers.", CORRECT)
    return values.astype(np.int64)


def _vectors(file: Path, columns: dict[str, Array]) -> dict[str, Array]:
    """Put the elements of each vector side by side."""
    vectors: dict[str, dict[int, Array]] = {}
    single: dict[str, Array] = {}
    for name, values in columns.items():
        match = ELEMENT.fullmatch(name)
        if match is None or not match["name"]:
            single[name] = values
        else:
            vectors.setdefault(match["name"], {})[int(match["at"] or match["index"])] = values
    for name, elements in vectors.items():
        if name in single or [*sorted(elements)] not in ([*range(len(elements))], [*range(1, len(elements) + 1)]):
            raise DataError(f"{file} lacks an element of '{name}'; it has {sorted(elements)}.",
                            "number them 0, 1, ...")  # fmt: skip
    return single | {name: np.stack([elements[at] for at in sorted(elements)], 1) for name, elements in vectors.items()}


def _pictures(file: Path, name: str, cells: list[str]) -> LazyRows:
    folder = file.parent.resolve()
    where = f"'{name}' in {file}"

    def fetch(rows: NDArray[np.intp]) -> Array:
        return stack_pictures([_picture(folder, cells[row], f"{where}, line {row + 2},") for row in rows], where, rows)

    for row in range(len(cells)):
        _inside(folder, cells[row], f"{where}, line {row + 2},")
    first = fetch(np.zeros(1, np.intp))
    return LazyRows(fetch, (len(cells), *first.shape[1:]), first.dtype, where)


def _inside(folder: Path, cell: str, where: str) -> Path:
    picture = folder / cell
    if not picture.is_file() or not picture.resolve().is_relative_to(folder):
        raise DataError(f"{where} names '{cell[:80]}', which is not a picture in the folder.", CORRECT)
    return picture


def _picture(folder: Path, cell: str, where: str) -> Array:
    picture = _inside(folder, cell, where)
    check_limit("picture_bytes", picture.stat().st_size, str(picture), DataError)
    return decode_picture(picture.read_bytes(), str(picture))
