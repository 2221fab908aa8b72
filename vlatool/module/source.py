"""What every source is, and which one reads what a person names: one file each in ``vlatool/sources``, or a package's.

A source yields one ``Description``, however the policy was written down. Code of a policy is only found through it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from vlatool import registry
from vlatool.bundle.bundle import DIGEST, MANIFEST, Bundle
from vlatool.data import MAP_HELP, PURPOSES, named_recording, reader_of
from vlatool.errors import SourceError
from vlatool.module.description import Description, file_source
from vlatool.module.foreign_files import foreign, foreign_format
from vlatool.registry import Claim
from vlatool.stage.base import Stage, Transform
from vlatool.stage.record import made_by

if TYPE_CHECKING:
    from typing_extensions import Self

RECORDING_OPTIONS = (*PURPOSES, "map")
"""Options of every source that name recordings."""


@dataclass(frozen=True)
class RecordingOptions:
    """Recordings that a user names beside a policy.

    Args:
        calibration, evaluation: a file or a directory each; empty for what the policy itself names.
        map: ``NAME=RECORDED`` of the names that they have for those of the spec.
    """

    calibration: str = ""
    evaluation: str = ""
    map: tuple[str, ...] = ()


OWN_RECORDINGS = RecordingOptions()
"""What the policy itself names."""


class Source(Transform):
    """A way of obtaining a policy: the stage that starts a chain."""

    needs: ClassVar[str] = ""
    """What it reads, for messages: ``a .onnx file``."""
    policy: Path | None = None
    """What holds the description of the policy; None where only its graphs say what it is."""
    calibration: Path | None = Field(None, description="recordings to calibrate with; those of policy.yaml if unset")
    evaluation: Path | None = Field(None, description="recordings to evaluate on; those of policy.yaml if unset")
    map: tuple[str, ...] = Field((), description=MAP_HELP)

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Say how sure it is that this source reads what a person types as SOURCE; cheap, and nothing is changed."""
        raise NotImplementedError

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a typed SOURCE that this source claims; raises SourceError when it is wrong."""
        return cls.model_validate({"policy": Path(typed)})

    def describe(self) -> Description | None:
        """Return the description of the policy; None where only its graphs say what it is, once they are read.

        Raises:
            SourceError: when it is missing or wrong.
        """
        return None

    @property
    def has_graphs(self) -> bool:
        """Whether the policy is graphs already, so that nothing is exported."""
        described = self.describe()
        return described is None or bool(described.graphs)

    def converted_directory(self) -> Path | None:
        """Return the policy directory in the cache that a checkpoint was converted into; None where there is none."""
        return None

    def described_by(self, description: Path) -> Self:
        """Return the same source with the ``policy.yaml`` that names it."""
        return self.model_copy(update={"policy": description})

    def with_recordings(self, recordings: RecordingOptions) -> Self:
        """Return the same source with recordings in the place of those that its description names.

        Raises:
            DataError: when one does not exist, or is of an unknown format.
            UsageError: when a name is mapped in a wrong way, or there is no recording that it could be of.
        """
        paths = {purpose: Path(named) for purpose in PURPOSES if (named := getattr(recordings, purpose))}
        for path in paths.values():
            reader_of(path)
        named_recording(next(iter(paths.values()), None), recordings.map)
        return self.model_copy(update={**paths, "map": recordings.map})

    def with_given(self, described: Description) -> Description:
        """Return a description with the recordings that the options name in the place of its own."""
        paths = {purpose: path for purpose in PURPOSES if (path := getattr(self, purpose))}
        named = {purpose: named_recording(path, self.map) for purpose, path in paths.items()}
        maps = {purpose: recording.names for purpose, recording in named.items() if recording}
        return replace(described, **paths, maps={**described.maps, **maps})

    def record(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the entry of the build record, with options and those that name recordings."""
        entry = made_by(self)
        recordings = {name: value for name, value in entry["options"].items() if name in RECORDING_OPTIONS}
        return {**entry, "options": {**options, **recordings}}

    def trust_code(self) -> Self:
        """Allow the policy's code to run in this process: the user typed its folder."""
        return self

    def as_recorded(self, entry: Mapping[str, Any], bundle: Bundle) -> Self:
        """Return the same source with the options that the build record of a bundle has for it.

        Raises:
            SourceError: when the record does not fit this source.
        """
        return self


def is_bundle(typed: str | Path) -> bool:
    """Return whether a path is a bundle: what has a manifest, unless that is of a format that a source reads."""
    path = Path(typed)
    if not (path / MANIFEST).is_file() or (path / DIGEST).exists():
        return (path / MANIFEST).is_file()
    return foreign_format(path / MANIFEST) is None and not registry.is_certain("sources", str(typed))


def claimed_source(typed: str | Path) -> Source | None:
    """Return the source that claims a path, or ``path.py:make``; None for a bundle, and what no source claims.

    None of the policy's code may run for that alone.

    Raises:
        SourceError: when several claim it, or it is wrong.
    """
    if is_bundle(typed):
        return None
    described, named = file_source(Path(typed)) or (None, typed)
    source: type[Source] | None = registry.claimant("sources", str(named), SourceError)
    if source is None:
        return None
    found = source.of(str(named))
    return found if described is None else found.described_by(described)


def trust_policies(stage: Stage) -> None:
    """Let the code of the policies that options of a stage name run in this process: the user typed them."""
    for policy in (getattr(stage, name) for name in stage.policies):
        if policy and (source := claimed_source(policy)):
            source.trust_code()


def source_of_policy(typed: str | Path) -> Source:
    """Return the source that claims a path, or ``path.py:make``.

    Raises:
        SourceError: as ``claimed_source``, and for a bundle, and what no source claims.
    """
    source = claimed_source(typed)
    if source is None:
        raise _unknown(str(typed))
    return source


def describe(policy: Path) -> Description:
    """Return the description of a policy, read by the source that claims it; raises SourceError when there is none."""
    described = source_of_policy(policy).describe()
    if described is None:
        raise SourceError(f"{policy} has no description.", "write a policy.yaml beside it")
    return described


def _unknown(typed: str) -> SourceError:
    """Return the error of what no source claims; it lists the kinds of sources, and what each needs."""
    path = Path(typed)
    if is_bundle(path):
        return SourceError(f"{path} is a bundle; the policy that it was made from is needed.", "name the policy")
    known = f"give a bundle, or a source: {registry.requirements('sources')}"
    if not path.exists():
        return SourceError(f"'{typed}' is neither a bundle nor a policy source; there is no such file.", known)
    about = foreign(path)
    if not path.is_dir():
        what = "neither a bundle nor a policy source" if about is None else about.what
        return SourceError(f"'{typed}' is {what}.", known if about is None else about.remedy)
    names = ", ".join(sorted(file.name for file in path.iterdir())[:6]) or "nothing"
    return SourceError(
        f"{path} is not a bundle: it has no {MANIFEST}; and no source of policies reads it (found: {names})"
        f"{f'; it looks like {about.what}' if about else ''}.",
        known if about is None else f"{about.remedy}; else {known}",
    )
