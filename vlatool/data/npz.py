"""NumPy archives: one array for each input of the spec, with a leading sample axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from vlatool.errors import DataError
from vlatool.host import memory
from vlatool.limits import check
from vlatool.npz_files import declared_bytes, open_npz

LIMIT = "recording_bytes"


class NpzReader:
    """Reads ``.npz``: input name -> (N, ...), ``action`` (or the output's name) and ``episode`` where recorded."""

    @staticmethod
    def read(path: Path) -> dict[str, NDArray[Any]]:
        """Return the arrays of a file by name.

        Raises:
            DataError: when the file is corrupt, is a single array, holds Python objects, or would not fit into the
                limit or the memory; before anything is unpacked.
        """
        needed = declared_bytes(path)
        check(LIMIT, needed, f"{path}, unpacked,", DataError)
        free = _free_mb()
        if free is not None and needed > free * 1e6:
            raise DataError(
                f"{path} takes {needed / 1e6:,.0f} MB of memory, unpacked; {free:,.0f} MB are free.",
                "record fewer samples, or use a machine with more memory",
            )
        return open_npz(path, LIMIT)


def _free_mb() -> float | None:
    """Return how much memory a process may still take in MB; None where it is not known."""
    found = memory()
    told = [found[name] for name in ("memory_available_mb", "memory_limit_mb")]
    return min((each for each in told if each is not None), default=None)
