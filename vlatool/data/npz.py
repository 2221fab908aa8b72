"""NumPy archives: one array for each input of the spec, with a leading sample axis."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError


class NpzReader:
    """Reads ``.npz``: input name -> (N, ...), ``action`` (or the output's name) and ``episode`` where recorded."""

    @staticmethod
    def read(path: Path) -> dict[str, NDArray[Any]]:
        """Return the arrays of a file by name.

        Raises:
            DataError: when the file is corrupt, is a single array, or holds Python objects.
        """
        try:
            with path.open("rb") as stream:
                stored = np.load(stream, allow_pickle=False)
                if not hasattr(stored, "files"):
                    raise DataError(f"{path} is one array, not an archive of named arrays.", "write it with np.savez")
                return {name: stored[name] for name in stored.files}
        except (
            OSError,
            ValueError,
            EOFError,
            NotImplementedError,
            zlib.error,
            zipfile.BadZipFile,
            zipfile.LargeZipFile,
        ) as error:
            reason = "it holds pickled objects, which are refused" if "pickle" in str(error) else str(error)
            raise DataError(f"{path} cannot be read: {reason}.", "write it again with np.savez") from error
