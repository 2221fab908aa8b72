"""What a source bundle may run of a policy's code: what the policy's own description names, where that is trusted."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError
from vlatool.module.description import read_location
from vlatool.module.factory import OWN_NAME, call_factory, factory_file, split_factory
from vlatool.module.source import describe
from vlatool.user_code import trust

RESTART = "start again from the source"


@dataclass(frozen=True)
class Origin:
    """Where a policy's modules come from.

    Args:
        folder: the policy's folder, which the user named or trusted.
        factory: ``path.py:make`` or ``package.module:make``.
        weights: glob of the shards that vlatool loads; empty when the factory does.
        code: file beside the factory -> its SHA-256 when the source bundle was made.
        environment: ``make`` and ``tasks`` of the environment that the policy's description names.
        program: how the description lets its graphs run.
        training: ``FILE.py:FUNCTION`` that yields batches to train on, as the description has it; empty for none.
    """

    folder: Path
    factory: str
    arguments: dict[str, Any] = field(default_factory=dict)
    weights: str = ""
    code: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, Any] = field(default_factory=dict)
    program: tuple[ProgramStep, ...] = ()
    training: str = ""

    def check(self, endings: tuple[str, ...] = ()) -> None:
        """Check every file, or those with these endings; raises SourceError naming one that is not what it was."""
        path = factory_file(self.factory, self.folder)
        for name, digest in self.code.items():
            file = (path.parent if path else self.folder) / name
            if endings and not name.endswith(endings):
                continue
            if not file.is_file() or hash_file(file) != digest:
                raise SourceError(f"{file} has changed since the source bundle was made.", RESTART)

    def build(self) -> Any:
        """Call the factory; raises SourceError when it fails, or imports a file of its folder that was not recorded."""
        before = set(sys.modules)
        product = call_factory(self.factory, self.folder, dict(self.arguments))
        self._check_imports({name: module for name, module in sys.modules.items() if name not in before})
        return product

    def _check_imports(self, loaded: Mapping[str, Any]) -> None:
        path = factory_file(self.factory, self.folder)
        for name, module in loaded.items():
            file = Path(str(getattr(module, "__file__", None) or os.devnull))
            if path is None or name.startswith(OWN_NAME) or not file.resolve().is_relative_to(path.parent):
                continue
            own = file.resolve().relative_to(path.parent)
            if own.suffix == ".py" and "site-packages" not in own.parts and own.as_posix() not in self.code:
                raise SourceError(
                    f"The factory '{self.factory}' imports {own}, which no import statement of its files names, so "
                    "its changes would not be noticed.",
                    f"import it with an import statement, or name it in policy.yaml: files: [{own}]",
                )


def origin_of(bundle: Bundle) -> Origin:
    """Return what a source bundle may run.

    Factory, arguments and weights are those of the description in the policy's folder; the bundle can only agree. A
    function of another file of that folder may be named, as ``path.py:make`` on the command line does.

    Raises:
        SourceError: when the bundle names no factory, its folder is neither named nor trusted, or it says otherwise
            than the description.
    """
    recorded = bundle.manifest.source
    factory = recorded.get("factory")
    if not isinstance(factory, str):
        raise SourceError(
            f"{bundle.path} was not made from a torch policy; it has nothing to export.",
            "run the bundle itself, or name the policy: its directory, or path.py:make",
        )
    folder = read_location(bundle.path)
    where, function = split_factory(factory)
    named = trust.require(folder, f"{function}() of {where}")
    described = describe(Path(named.description) if named.description else folder)
    installed = factory == described.factory and factory_file(factory, folder) is None
    if not installed and (named.remembered or factory not in (described.factory, named.factory)):
        _check_own(factory, folder, bundle)
    own = {"arguments": json.loads(json.dumps(described.arguments, default=str)), "weights": described.weights}
    for key in own:
        if key in recorded and recorded[key] != own[key]:
            raise SourceError(
                f"{bundle.path} says {key}: {recorded[key]!r}; the policy's description says {own[key]!r}.", RESTART
            )
    return Origin(
        folder, factory, described.arguments, described.weights, _code(bundle), described.environment,
        described.program, described.training,
    )  # fmt: skip


def _check_own(factory: str, folder: Path, bundle: Bundle) -> None:
    """Refuse a factory outside of the policy's own files."""
    file = factory_file(factory, folder)
    if file is None or not file.is_relative_to(folder.resolve()):
        raise SourceError(
            f"{bundle.path} names the factory {factory}, which the description in {folder} does not name.",
            f"a factory is a function in the policy's own files, or what its policy.yaml names; {RESTART}",
        )


def _code(bundle: Bundle) -> dict[str, str]:
    code = bundle.manifest.source.get("code", {})
    if not isinstance(code, Mapping):
        raise SourceError(f"{bundle.path} has an invalid record of the policy's code.", RESTART)
    for name in code:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or str(PurePosixPath(name)) != name:
            raise SourceError(f"{bundle.path} records the code {name!r}, which is not beside the factory.", RESTART)
    return {str(name): str(digest) for name, digest in code.items()}
