"""A policy that a Python function builds as a torch module."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from pydantic import Field

from vlatool import trust
from vlatool.bundle import Bundle, hash_file, seal
from vlatool.errors import MissingExtra, SourceError, SpecError
from vlatool.kept_files import carry
from vlatool.manifest import Manifest
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.statistics import load_normaliser
from vlatool.sources._description import Description, read_description, write_location
from vlatool.sources._factory import factory_file, split_factory
from vlatool.sources._imports import imported_files
from vlatool.sources._shards import fingerprint, sampled_hash, shard_files
from vlatool.stage import Context, Transform

if TYPE_CHECKING:
    from vlatool.profile import Profile

DATA = ("*.safetensors", "*.pt", "*.pt2", "*.pth", "*.bin", "*.ckpt")
"""Files beside the factory that it may read, where ``files`` in policy.yaml does not say which it does."""


class TorchModule(Transform):
    """A policy that a Python function builds as a torch module (or, for several graphs, as a dict of modules).

    The bundle holds the spec, the assets and the recorded data; code and weights stay where they are and are recorded
    by hash, so that nothing large is copied.
    """

    policy: Path = Field(description="policy.yaml, or the directory that holds it")
    factory: str = Field("", description="path.py:make or package.module:make; the one in policy.yaml when empty")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The description is readable and names a factory that exists."""
        self._factory(read_description(self.policy))

    def inputs(self) -> tuple[Path, ...]:
        """Everything that the policy is made of."""
        described = read_description(self.policy)
        data = [path for path in (described.calibration, described.evaluation) if path]
        assets = [described.folder / name for name in sorted(described.assets())]
        description = self.policy / "policy.yaml" if self.policy.is_dir() else self.policy
        return (description, *assets, *data, *self._code(described))

    def key(self, source_hash: str) -> str:
        """The bundle notes where the code is, so the place belongs to the key."""
        described = read_description(self.policy)
        return super().key(f"{described.folder.resolve()} {_shards(described)}")

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Write the spec, the assets and the recorded data."""
        described = read_description(self.policy)
        self.name_it()
        copy_assets(described, out)
        factory = self._factory(described)
        root = self._root(described)
        code = {path.relative_to(root).as_posix(): hash_file(path) for path in self._code(described)}
        write_location(out, described.folder)
        manifest = Manifest(
            name=described.name,
            version=described.version,
            spec=described.spec,
            program=described.program,
            made_by={**self.made_by(), "options": {}},
            source={"factory": factory, "arguments": described.arguments, "code": code, **_weights(described)},
            environment=described.environment,
            parts=described.parts,
            description=described.description,
            license=described.license,
        )
        return seal(out, manifest)

    def name_it(self) -> None:
        """Let the policy's code run in this process: the user named its folder."""
        trust.name(read_description(self.policy).folder, None if self.policy.is_dir() else self.policy, self.factory)

    def _factory(self, described: Description) -> str:
        factory = self.factory or described.factory
        if not factory:
            raise SourceError(
                f"{described.folder} names no factory.",
                "add 'source: policy.py:make' to policy.yaml, or pass --factory",
            )
        split_factory(factory)
        path = factory_file(factory, described.folder)
        if path is not None and not path.is_file():
            raise SourceError(f"There is no file {path} (from '{factory}').")
        return factory

    def _code(self, described: Description) -> list[Path]:
        """Return the code that the policy and its environment import from its folder, and the data that they read."""
        path = factory_file(self._factory(described), described.folder)
        if path is None:
            return []
        folder = self._root(described)
        environment = str(described.environment.get("make", "")).rpartition(":")[0]
        beside = (described.folder / environment).resolve() if environment.endswith(".py") else path
        roots = [path, *([beside] if beside.is_relative_to(folder) else [])]
        shards = set(described.folder.resolve().glob(described.weights)) if described.weights else set()
        return sorted((imported_files(roots, folder) | self._data(described, folder)) - shards)

    def _data(self, described: Description, folder: Path) -> set[Path]:
        """Return the files that the factory reads: those that ``files`` names, else all that hold weights."""
        if described.files is None:
            return {found for pattern in DATA for found in folder.glob(pattern)}
        found: set[Path] = set()
        for pattern in described.files:
            files = {file for file in described.folder.resolve().glob(pattern) if file.is_file()}
            if not files or not all(file.is_relative_to(folder) for file in files):
                raise SourceError(
                    f"{described.folder} says files: {pattern}, of which there is none beside the factory.",
                    "name files or globs below the folder of the factory",
                )
            found |= files
        return found

    def _root(self, described: Description) -> Path:
        """Return the folder that the factory's imports begin in."""
        path = factory_file(self._factory(described), described.folder)
        return path.parent if path is not None else described.folder.resolve()


def _shards(described: Description) -> str:
    """Return a fingerprint of the shards that vlatool itself loads, with their times of change."""
    return fingerprint(shard_files(described.folder, described.weights)) if described.weights else ""


def _weights(described: Description) -> dict[str, str]:
    """Return what the manifest says of such shards."""
    if not described.weights:
        return {}
    return {"weights": described.weights, "shards": sampled_hash(shard_files(described.folder, described.weights))}


def copy_assets(described: Description, out: Path) -> None:
    """Copy tokenizers and statistics to ``assets/``, recorded data to ``data/``.

    Raises:
        SourceError: when a file that the spec names is missing.
        SpecError: when statistics or a vocabulary do not fit the spec; names the user's file, not the copy.
    """
    for name in sorted(described.assets()):
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise SourceError(f"The spec names {name}, which is not inside {described.folder}.")
        if not (described.folder / name).is_file():
            raise SourceError(f"The spec names {name}, which is not in {described.folder}.")
        target = out / "assets" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(described.folder / name, target)
    check_assets(described, out / "assets")
    for key, path in (("calibration", described.calibration), ("evaluation", described.evaluation)):
        if path is not None:
            (out / "data").mkdir(exist_ok=True)
            carry(path, out / "data" / f"{key}.npz")


def check_assets(described: Description, copies: Path) -> None:
    """Read the copies of tokenizers and statistics as a robot would; what a robot would need for it may be absent.

    Raises:
        SpecError: when one does not fit the spec; names the file that was copied.
    """
    try:
        with contextlib.suppress(MissingExtra):
            ObservationEncoder(described.spec, copies)
        for tensor in described.spec.outputs:
            load_normaliser(tensor, copies)
    except SpecError as error:
        raise SpecError(error.message.replace(str(copies), str(described.folder)), error.fix) from error
