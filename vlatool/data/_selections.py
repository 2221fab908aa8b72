"""What calibrates and what evaluates: selections of the recordings that a bundle carries, or of one that is named.

A recording that a person names is used as a whole. A bundle that carries a recording for both purposes uses each for
its own; a calibration recording alone serves both purposes by halves (``halves``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec
from vlatool.data._halves import MIN_HALF, halves
from vlatool.data._reader import NamedRecording, read_recording, reader_of
from vlatool.data._recording import Recording
from vlatool.data._sampling import rows_to_carry, save_recording
from vlatool.errors import DataError
from vlatool.files.blob_store import link_or_copy

PURPOSES = CALIBRATION, EVALUATION = "calibration", "evaluation"
_RECORDING_FILE = re.compile(rf"(?P<path>data/(?P<purpose>{'|'.join(PURPOSES)})(\.[^/]*)?)(/.+)?")
"""A file of a recording in a bundle; where that is a directory, one below it."""


@dataclass(frozen=True)
class Selection:
    """Observations that serve one purpose.

    Args:
        half: Index of a half, as ``halves`` gives them; None for the whole recording.
    """

    recording: Path | NamedRecording
    half: int | None = None

    def read(self, spec: PolicySpec) -> Recording:
        """Read the observations.

        Raises:
            DataError: when the recording is missing, corrupt, or does not fit the spec.
        """
        recording = read_recording(self.recording, spec)
        return recording if self.half is None else halves(recording)[self.half]


@dataclass(frozen=True)
class Recordings:
    """Recordings that a bundle carries, each a file or a directory; None where it carries none."""

    calibration: Path | None = None
    evaluation: Path | None = None

    def select(self, purpose: str, named: Path | NamedRecording | None = None) -> Selection | None:
        """Return the observations for one of ``PURPOSES``, None where there are none.

        Args:
            named: Recording to use in the place of the bundle's own.
        """
        if whole := named or (self.evaluation if purpose == EVALUATION else None):
            return Selection(whole)
        if self.calibration is None:
            return None
        return Selection(self.calibration, None if self.evaluation else PURPOSES.index(purpose))


def recordings_of(bundle: Bundle) -> Recordings:
    """Return the recordings that a bundle carries.

    Raises:
        DataError: when it carries two for one purpose.
    """
    found: dict[str, Path] = {}
    for match in filter(None, map(_RECORDING_FILE.fullmatch, bundle.manifest.files)):
        path = bundle.path / match["path"]
        if found.setdefault(match["purpose"], path) != path:
            raise DataError(
                f"{bundle.path} carries two recordings for {match['purpose']}: {found[match['purpose']].name} and "
                f"{path.name}.",
                "export the policy again; a bundle carries one for each purpose",
            )
    return Recordings(**found)


def is_of_recording(name: str) -> bool:
    """Return whether a file of a bundle, by its name in the manifest, belongs to a recording that it carries."""
    return _RECORDING_FILE.fullmatch(name) is not None


def carry_recording(
    recording: Path | NamedRecording, purpose: str, spec: PolicySpec, out: Path, *, keeps: bool = False
) -> None:
    """Put a recording into a new bundle, once it was found to fit, while it has the name that the user knows.

    Of a dataset, and of a recording with other names, it is a sample or a copy under the names of the spec.

    Args:
        purpose: One of ``PURPOSES``.
        keeps: Whether the policy keeps values: a sample is then whole episodes.

    Raises:
        DataError: when it cannot be read, or does not fit the spec.
    """
    named = recording if isinstance(recording, NamedRecording) else NamedRecording(recording)
    reader = reader_of(named.path)
    opened = reader.open(named.path, spec, named.names)
    (out / "data").mkdir(parents=True, exist_ok=True)
    if not reader.carries_sample and not named.names:
        link_or_copy(named.path, out / "data" / f"{purpose}{reader.suffix}")
        return
    if reader.carries_sample:
        chosen = np.zeros(len(opened), np.bool_)
        chosen[rows_to_carry(opened, keeps)] = True
        opened = opened.subset(chosen)
    save_recording(opened, out / "data" / f"{purpose}.npz")


def calibration_recording(source: Bundle, path: Path | NamedRecording | None = None) -> Recording | None:
    """Return what calibrates a bundle, or all of the recording at ``path``; None when there is neither.

    Raises:
        DataError: when it is missing, corrupt, or does not fit the spec.
    """
    selection = recordings_of(source).select(CALIBRATION, path)
    return None if selection is None else selection.read(source.manifest.spec)


def evaluation_recording(source: Bundle, path: Path | NamedRecording | None = None) -> tuple[Recording, str]:
    """Return what evaluates a bundle, and a reservation about it, empty when there is none.

    Args:
        source: With an evaluation recording, or a calibration recording of which a half is held out.
        path: A recording to read in the place of the bundle's own.

    Raises:
        DataError: when there is none, or it is missing, corrupt, or does not fit the spec.
    """
    selection = recordings_of(source).select(EVALUATION, path)
    if selection is None:
        raise DataError(f"{source.path} carries no evaluation data.", "pass --data FILE.npz")
    recording = selection.read(source.manifest.spec)
    return recording, "" if selection.half is None else _reservation(recording)


def carries_evaluation(source: Bundle) -> bool:
    """Return whether a bundle carries what evaluates it: a recording for that, or one for calibration."""
    return recordings_of(source).select(EVALUATION) is not None


def _reservation(held_out: Recording) -> str:
    if held_out.whole is not None:
        return (
            f"there is no evaluation recording: the errors are taken on {len(held_out)} of the {len(held_out.whole)} "
            "observations for calibration, held out of it; to use others: --evaluation, or evaluation: in policy.yaml"
        )
    return (
        f"there is no evaluation recording, and {len(held_out)} calibration observations are too few to hold out a "
        f"half: what calibrates is what evaluates, which flatters it; record {2 * MIN_HALF} or more, or name others: "
        "--evaluation, or evaluation: in policy.yaml"
    )
