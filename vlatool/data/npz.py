"""NumPy archives: one array for each input of the spec, with a leading sample axis."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.data._reader import Reader
from vlatool.data._recording import Recording, Values, build_recording
from vlatool.data._steps import Steps
from vlatool.files.npz import open_rows
from vlatool.files.rows import in_memory
from vlatool.machine.host import memory
from vlatool.registry import Claim

LIMIT = "recording_bytes"


class NpzReader(Reader):
    """Reads ``.npz``: input name -> (N, ...), ``action`` (or the output's name) and ``episode`` where recorded."""

    suffix: ClassVar[str] = ".npz"
    needs: ClassVar[str] = "a .npz file"

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Claim a .npz file, and perhaps what else is an archive."""
        if path.name.endswith(cls.suffix):
            return Claim.CERTAIN
        return Claim.MAYBE if path.is_file() and _holds_arrays(path) else Claim.NONE

    def open(self, path: Path, spec: PolicySpec, names: Mapping[str, str]) -> Recording:
        """Open a recording, large arrays as rows that stay on the disk.

        Raises:
            DataError: when the file is corrupt, is a single array, holds Python objects, or would not fit into the
                limit, or what is not an array of rows into the memory, before anything is unpacked; when it does not
                fit the spec.
        """
        return build_recording(path, _arrays(path), spec, names)

    def steps(self, path: Path) -> Steps:
        """Return the arrays of a recording as columns.

        Raises:
            DataError: when the file is corrupt, or its arrays have different numbers of rows.
        """
        arrays = {name: values for name, values in _arrays(path).items() if values.ndim}
        count = max((len(values) for values in arrays.values()), default=0)
        episodes = in_memory(arrays.pop("episode")) if "episode" in arrays else np.zeros(count, np.int64)
        return Steps(path, arrays, episodes, action="action" if "action" in arrays else "")


def _arrays(path: Path) -> dict[str, Values]:
    free = _free_mb()
    return dict(open_rows(path, LIMIT, free=None if free is None else free * 1e6))


def _free_mb() -> float | None:
    """Return how much memory a process may still take in MB; None where it is not known."""
    figures = memory()
    known = [figures[name] for name in ("memory_available_mb", "memory_limit_mb")]
    return min((value for value in known if value is not None), default=None)


def _holds_arrays(path: Path) -> bool:
    """Return whether a file is an archive with an array of NumPy's in it; torch's checkpoints are archives, too."""
    with contextlib.suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        return any(name.endswith(".npy") for name in archive.namelist())
    return False
