"""Base class of the readers of recordings, one file for each format, and the choice of the reader for a path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from vlatool import registry
from vlatool.bundle.spec import PolicySpec
from vlatool.data._recording import Recording
from vlatool.data._steps import Steps
from vlatool.errors import DataError, UsageError, suggest
from vlatool.registry import Claim

MAP_HELP = (
    "NAME=RECORDED where a recording has another name for an input or the action; RECORDED may be a part or several "
    "parts: state[0:7]+gripper"
)
"""Help of the option --map."""


@dataclass(frozen=True)
class NamedRecording:
    """A recording that a person names.

    Args:
        path: A file or a directory.
        names: Name in the spec -> name in the recording, where they differ.
    """

    path: Path
    names: Mapping[str, str] = field(default_factory=dict)


def named_recording(path: Path | None, pairs: Sequence[str]) -> NamedRecording | None:
    """Return the recording of an option and its ``--map SPEC=RECORDED``; None where no path is given.

    Raises:
        UsageError: as ``mapped_names`` does, and for pairs without a path.

    Example:
        >>> named_recording(Path("a"), ["state=observation.state"]).names
        {'state': 'observation.state'}
    """
    names = mapped_names(pairs)
    if names and path is None:
        raise UsageError("--map says how a recording names things, and none is given.", "name the recording, too")
    return None if path is None else NamedRecording(path, names)


def mapped_names(pairs: Sequence[str]) -> dict[str, str]:
    """Return name in the spec -> other name, of ``--map SPEC=OTHER``.

    Raises:
        UsageError: for a pair without a name on each side, and a name that is mapped twice.

    Example:
        >>> mapped_names(["state=observation.state"])
        {'state': 'observation.state'}
    """
    names: dict[str, str] = {}
    for pair in pairs:
        name, _, recorded = (part.strip() for part in pair.partition("="))
        if not (name and recorded):
            raise UsageError(f"--map is '{pair}'; it must be NAME=RECORDED.", "write --map state=observation.state")
        if name in names:
            raise UsageError(f"--map names '{name}' twice.", "map each name of the spec once")
        names[name] = recorded
    return names


class Reader:
    """Reads recordings of one format, each a file or a directory."""

    suffix: ClassVar[str] = ""
    """Suffix of its recordings, with the dot; bundles store them under a name with this suffix."""
    needs: ClassVar[str] = ""
    """What the reader reads, for messages: ``a .npz file``."""
    carries_sample: ClassVar[bool] = False
    """Whether bundles carry a sample of such a recording as .npz, since it may be far larger than they are."""

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Return how sure this reader is that it can read a path; by the suffix, unless a subclass checks more."""
        return Claim.CERTAIN if cls.suffix and path.name.endswith(cls.suffix) else Claim.NONE

    def steps(self, path: Path) -> Steps:
        """Return what a recording holds, without a spec: for ``vlatool data``.

        Raises:
            DataError: when it is corrupt, or the reader does not say.
        """
        raise DataError(
            f"{path} cannot be read without a policy.", "name it where a policy is given: --data, --calibration"
        )

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


def read_recording(
    recording: Path | NamedRecording, spec: PolicySpec, names: Mapping[str, str] | None = None
) -> Recording:
    """Read a recording with the reader that claims it.

    Args:
        names: Name in the spec -> name in the recording, where they differ.

    Raises:
        DataError: when it is missing, of an unknown format, corrupt, or does not fit the spec.
    """
    named = recording if isinstance(recording, NamedRecording) else NamedRecording(recording, names or {})
    return reader_of(named.path).open(named.path, spec, named.names)
