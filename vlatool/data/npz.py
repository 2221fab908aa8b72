"""NumPy archives: one array for each input of the spec, with a leading sample axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from vlatool.files.npz import open_rows
from vlatool.files.rows import Rows
from vlatool.machine.host import memory

LIMIT = "recording_bytes"


class NpzReader:
    """Reads ``.npz``: input name -> (N, ...), ``action`` (or the output's name) and ``episode`` where recorded."""

    @staticmethod
    def read(path: Path) -> dict[str, NDArray[Any] | Rows]:
        """Return the arrays of a file by name, large ones as rows that stay on the disk.

        Raises:
            DataError: when the file is corrupt, is a single array, holds Python objects, or would not fit into the
                limit, or what is no array of rows into the memory; before anything is unpacked.
        """
        free = _free_mb()
        return open_rows(path, LIMIT, free=None if free is None else free * 1e6)


def _free_mb() -> float | None:
    """Return how much memory a process may still take in MB; None where it is not known."""
    figures = memory()
    known = [figures[name] for name in ("memory_available_mb", "memory_limit_mb")]
    return min((value for value in known if value is not None), default=None)
