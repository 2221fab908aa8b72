"""What every reader of recordings is, and which one reads what a person names: one file for each format."""

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
    """How names of its recordings end, with the dot; bundles carry them under such a name."""
    needs: ClassVar[str] = ""
    """What it reads, for messages: ``a .npz file``."""

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Say how sure it is that this reader reads a path; by its suffix, unless a reader looks at more."""
        return Claim.CERTAIN if cls.suffix and path.name.endswith(cls.suffix) else Claim.NONE

    def open(self, path: Path, spec: PolicySpec, names: Mapping[str, str]) -> Recording:
        """Open a recording; large arrays stay on the disk (``files.rows.Rows``), and are read row by row.

        Args:
            path: An existing file or directory, which is read and never written.
            spec: What the policy takes and gives; ``build_recording`` checks arrays against it.
            names: Name in the spec -> name in the recording, where they differ.

        Raises:
            DataError: when it is corrupt, or does not fit the spec.
        """
        raise NotImplementedError


def reader_of(path: Path) -> Reader:
    """Return the reader of a recording.

    Raises:
        DataError: when nothing is there, no reader claims it, or several do.
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
