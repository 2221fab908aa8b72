"""A policy that a Python function builds as a torch module."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle, hash_file, seal
from vlatool.errors import SourceError
from vlatool.module.description import (
    FILE,
    Description,
    carry_recordings,
    copy_assets,
    read_description,
    write_location,
)
from vlatool.module.factory import factory_file, split_factory
from vlatool.module.imports import imported_files
from vlatool.module.source import Source
from vlatool.registry import Claim
from vlatool.sources._onnx_files import refuse_bare
from vlatool.stage.base import Context, Result
from vlatool.user_code import trust
from vlatool.weights.shards import fingerprint, sampled_hash, shard_files

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

DATA = ("*.safetensors", "*.pt", "*.pt2", "*.pth", "*.bin", "*.ckpt")
"""Files beside the factory that it may read, where ``files`` in policy.yaml does not say which it does."""


class TorchModule(Source):
    """A policy that a Python function builds as a torch module (or, for several graphs, as a dict of modules).

    The bundle holds the spec, the assets and the recorded data; code and weights stay where they are and are recorded
    by hash, so that nothing large is copied.
    """

    needs: ClassVar[str] = f"a directory with a {FILE}, or path/to/policy.py:make beside one"

    runs_graphs: ClassVar[bool] = False
    policy: Path = Field(description="policy.yaml, or the directory that holds it")
    factory: str = Field("", description="path.py:make or package.module:make; the one in policy.yaml when empty")

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim what holds or is a ``policy.yaml``, and ``path.py:make``; perhaps other YAML files."""
        path = Path(typed)
        function = typed.rpartition(":")
        if path.name == FILE or (path / FILE).is_file() or (function[0].endswith(".py") and function[2]):
            return Claim.CERTAIN
        return Claim.MAYBE if path.suffix in (".yaml", ".yml") else Claim.NONE

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a directory or YAML file that describes a policy, or ``path.py:make`` beside one."""
        where, _, function = typed.rpartition(":")
        if not where.endswith(".py"):
            return cls(policy=Path(typed))
        if not Path(where).is_file():
            raise SourceError(f"No such file: {where} (from '{typed}').", "check the path")
        return cls(policy=Path(where).parent, factory=f"{Path(where).name}:{function}")

    def describe(self) -> Description:
        """Read ``policy.yaml``."""
        return self.with_given(read_description(self.policy))

    def as_recorded(self, entry: Mapping[str, Any], bundle: Bundle) -> Self:
        """Take the factory of the record: a function in the policy's own files, or what its description names."""
        factory = entry.get("factory", "")
        if self.factory and self.factory != factory:
            raise SourceError(
                f"{self.policy} names the factory {self.factory}; {bundle.path} was made by {factory}.",
                f"name the policy alone, or path.py:make of {factory}",
            )
        described = self.describe()
        file = factory_file(factory, described.folder)
        if factory != described.factory and (file is None or not file.is_relative_to(described.folder.resolve())):
            raise SourceError(
                f"The build record of {bundle.path} names the factory {factory}; {self.policy} does not.",
                f"pass --source DIR of the policy that has {factory}",
            )
        return self.model_copy(update={"factory": factory})

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The description is readable and names a factory that exists."""
        self._factory(self.describe())

    def inputs(self) -> tuple[Path, ...]:
        """Everything that the policy is made of."""
        described = self.describe()
        named = (*described.assets(), *described.recordings().values())
        return (*described.read_from, *named, *self._code(described))

    def key(self, source_hash: str) -> str:
        """The bundle notes where the code is, so the place belongs to the key."""
        described = self.describe()
        return super().key(f"{described.folder.resolve()} {_shards(described)}")

    def run(self, source: Bundle | None, out: Path, context: Context) -> Result:
        """Write the spec, the assets and the recorded data."""
        described = self.describe()
        self.trust_code()
        copy_assets(described, out)
        carry_recordings(described, out)
        factory = self._factory(described)
        root = self._root(described)
        code = {path.relative_to(root).as_posix(): hash_file(path) for path in self._code(described)}
        write_location(out, described.folder)
        source_record = {"factory": factory, "arguments": described.arguments, "code": code, **_weights(described)}
        return Result(seal(out, described.manifest(made_by=self.record({}), source=source_record)))

    def trust_code(self) -> Self:
        """Allow the policy's code to run in this process: the user named its folder."""
        folder = self.describe().folder
        trust.allow(folder, None if self.policy.resolve() == folder.resolve() else self.policy, self.factory)
        return self

    def _factory(self, described: Description) -> str:
        factory = self.factory or described.factory
        if not factory:
            refuse_bare(described.folder)
            raise SourceError(
                f"{described.folder} names no factory.",
                "add 'source: policy.py:make' to policy.yaml, or pass --factory",
            )
        split_factory(factory)
        path = factory_file(factory, described.folder)
        if path is not None and not path.is_file():
            raise SourceError(
                f"No such file: {path} (from '{factory}').", "put the file there, or correct 'source' in policy.yaml"
            )
        return factory

    def _code(self, described: Description) -> list[Path]:
        """Return the code that the policy, its environment and its batches import, and the data that they read."""
        path, folder = factory_file(self._factory(described), described.folder), self._root(described)
        training = _training(described, folder)
        if path is None:
            read = self._data(described, folder) if training and described.files is not None else set()
            return sorted(imported_files(training, folder) | read)
        environment = str(described.environment.get("make", "")).rpartition(":")[0]
        beside = (described.folder / environment).resolve() if environment.endswith(".py") else path
        roots = [path, *([beside] if beside.is_relative_to(folder) else []), *training]
        shards = set(described.folder.resolve().glob(described.weights)) if described.weights else set()
        return sorted((imported_files(roots, folder) | self._data(described, folder)) - shards)

    def _data(self, described: Description, folder: Path) -> set[Path]:
        """Return the files that the factory reads: those that ``files`` names, else all that hold weights."""
        if described.files is None:
            return {path for pattern in DATA for path in folder.glob(pattern)}
        data: set[Path] = set()
        for pattern in described.files:
            files = {file for file in described.folder.resolve().glob(pattern) if file.is_file()}
            if not files or not all(file.is_relative_to(folder) for file in files):
                raise SourceError(
                    f"{described.folder} says files: {pattern}, which matches nothing beside the factory.",
                    "name files or globs below the folder of the factory",
                )
            data |= files
        return data

    def _root(self, described: Description) -> Path:
        """Return the folder that the factory's imports begin in."""
        path = factory_file(self._factory(described), described.folder)
        return path.parent if path is not None else described.folder.resolve()


def _training(described: Description, folder: Path) -> list[Path]:
    """Return the file that yields batches to train on, if there is one; it lies where imports begin.

    Raises:
        SourceError: when it lies elsewhere: what it imports would not be found.
    """
    if not described.training:
        return []
    file = (described.folder / described.training.rpartition(":")[0]).resolve()
    if file.parent != folder.resolve():
        raise SourceError(
            f"{described.folder} says training: {described.training}, which lies in {file.parent}; the policy's code "
            f"lies in {folder}.",
            "put both into the same folder",
        )
    return [file]


def _shards(described: Description) -> str:
    """Return a fingerprint of the shards that vlatool itself loads, with their times of change."""
    return fingerprint(shard_files(described.folder, described.weights)) if described.weights else ""


def _weights(described: Description) -> dict[str, str]:
    """Return what the manifest says of such shards."""
    if not described.weights:
        return {}
    return {"weights": described.weights, "shards": sampled_hash(shard_files(described.folder, described.weights))}
