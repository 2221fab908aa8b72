"""Base class of the readers of recordings, one file for each format, and the choice of the reader for a path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from vlatool import registry
from vlatool.bundle.spec import PolicySpec
from vlatool.data._recording import Recording
from vlatool.errors import DataError, suggest
from vlatool.registry import Claim


class Reader:
    """Reads recordings of one format, each a file or a directory."""

    suffix: ClassVar[str] = ""
    """Suffix of its recordings, with the dot; bundles store them under a name with this suffix."""
    needs: ClassVar[str] = ""
    """What the reader reads, for messages: ``a .npz file``."""

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Return how sure this reader is that it can read a path; by the suffix, unless a subclass checks more."""
        return Claim.CERTAIN if cls.suffix and path.name.endswith(cls.suffix) else Claim.NONE

    def open(self, path: Path, spec: PolicySpec, names: Mapping[str, str]) -> Recording:
        """Open a recording; large arrays stay on disk (``files.rows.Rows``) and are read row by row.

        Args:
            path: Existing file or directory, which is only read.
            spec: Spec of the policy, against which ``build_recording`` checks the arrays.
            names: Name in the spec -> name in the recording, where they differ.

        Raises:
            DataError: when the recording is corrupt or does not fit the spec.
        """
        raise NotImplementedError


def reader_of(path: Path) -> Reader:
    """Return the reader of a recording.

    Raises:
        DataError: when the path does not exist, no reader claims it, or several do.
    """
    if not path.exists():
        raise DataError(f"Data file {path} not found.", "check the path, and record the file if there is none")
    reader: type[Reader] | None = registry.claimant("data", path, DataError)
    if reader is None:
        known = suggest(path.suffix.removeprefix("."), registry.names("data"))
        raise DataError(
            f"{path} is of an unknown format; {known}.",
            f"store it as .npz: np.savez(FILE, NAME=values); readers: {registry.requirements('data')}",
        )
    return reader()


def read_recording(path: Path, spec: PolicySpec, names: Mapping[str, str] | None = None) -> Recording:
    """Read a recording with the reader that claims it.

    Args:
        names: Name in the spec -> name in the recording, where they differ.

    Raises:
        DataError: when it is missing, of an unknown format, corrupt, or does not fit the spec.
    """
    return reader_of(path).open(path, spec, names or {})
