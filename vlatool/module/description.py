"""The description of a policy, however it is written down, and ``policy.yaml``, the usual form of it."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import LOCATION
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.program import ProgramStep, check_program, keeps_values, program_from, single_graph
from vlatool.bundle.spec import PolicySpec
from vlatool.data import PURPOSES, NamedRecording, carry_recording
from vlatool.errors import MissingExtra, SourceError, SpecError
from vlatool.files.printable import one_line, truncate
from vlatool.files.yaml import read_mapping
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.statistics import load_normaliser

FILE = "policy.yaml"
MAX_LABEL_CHARACTERS = 100
"""Characters of a policy's name, and of its version."""
KEYS = (
    "schema", "name", "version", "description", "license", "source", "arguments", "spec", "program", "environment",
    "parts", "calibration", "evaluation", "weights", "files", "training",
)  # fmt: skip
IN_MANIFEST = ("name", "version", "spec", "program", "environment", "parts", "description", "license")
"""Fields that a bundle's manifest takes from the description."""


@dataclass(frozen=True)
class Description:
    """What a source says of a policy.

    Args:
        folder: where relative paths start, and whose code runs once it is trusted.
        factory: ``path.py:make`` or ``package.module:make`` of the torch modules; empty for a policy that is graphs.
        graphs: graph name -> ONNX file, of a policy that is graphs already.
        program: how the graphs are run; one graph of all inputs and outputs when empty.
        environment: ``make`` (factory of a gymnasium environment) and ``tasks`` for closed-loop evaluation, and
            ``timeout``: seconds that a call of it may take.
        parts: part name -> globs of module names.
        calibration, evaluation: recordings, each a file or a directory, or None.
        maps: purpose of a recording -> name in the spec -> name in the recording, where they differ.
        weights: glob of safetensors files whose tensors have the names of ``state_dict()``; the factory then builds the
            module alone. Empty when the factory loads the weights.
        training: ``FILE.py:FUNCTION`` of the folder that yields batches of observations to train on; empty for none.
        files: globs of the files that the factory reads; None: every file of weights beside it.
        read_from: files that the description was read from, the one that names the policy first.
    """

    folder: Path
    name: str
    version: str
    spec: PolicySpec
    factory: str = ""
    graphs: Mapping[str, Path] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)
    program: tuple[ProgramStep, ...] = ()
    environment: dict[str, Any] = field(default_factory=dict)
    parts: dict[str, list[str]] = field(default_factory=dict)
    calibration: Path | None = None
    evaluation: Path | None = None
    maps: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    description: str = ""
    license: str = ""
    weights: str = ""
    files: tuple[str, ...] | None = None
    training: str = ""
    read_from: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        """Refuse code of another folder: only that of the one that is trusted, with all that is in it, may run."""
        for key, named in (("source", self.factory), ("environment", self.environment.get("make"))):
            where = str(named or "").rpartition(":")[0]
            if where.endswith(".py") and not _inside(where):
                raise SourceError(
                    f"{next(iter(self.read_from), self.folder)}: '{key}' names a file outside the folder of the "
                    f"policy: {truncate(str(named), 200)}.",
                    "copy or link what runs into the folder, or name an importable package: package.module:make",
                )
        if not self.program:
            object.__setattr__(self, "program", single_graph(self.spec))

    def assets(self) -> list[Path]:
        """Files in the folder that the spec needs on the robot."""
        names = {file for tensor in (*self.spec.inputs, *self.spec.outputs) for file in tensor.assets()}
        return [self.folder / name for name in sorted(names)]

    def recordings(self) -> dict[str, Path]:
        """Purpose -> recording, a file or a directory."""
        paths: dict[str, Path | None] = {purpose: getattr(self, purpose) for purpose in PURPOSES}
        return {purpose: path for purpose, path in paths.items() if path}

    def manifest(self, **fields: Any) -> Manifest:
        """Return the manifest of a bundle of this policy, with the fields that only its source knows."""
        own = {name: getattr(self, name) for name in IN_MANIFEST}
        return Manifest(**{**own, **fields})


def read_description(path: Path) -> Description:
    """Read ``policy.yaml``, or the one in a directory.

    Raises:
        SourceError: when it is missing, is not YAML, or lacks something.
        SpecError: when the spec or the program is impossible.
    """
    file = path / FILE if path.is_dir() else path
    if not file.exists():
        raise SourceError(f"No such file: {file}.", "a policy needs a description; see docs/guides/your-own-policy.md")
    data = read_mapping(file, str(file), SourceError)
    for key in data:
        if key not in KEYS:
            raise SourceError.unknown(f"{file} has the unknown key '{key}'", str(key), KEYS)
    if data.get("schema", 1) != 1:
        raise SourceError(f"{file} has the schema {data['schema']!r}; this vlatool reads 1.", "upgrade vlatool")
    for key in ("arguments", "environment", "parts"):
        if not isinstance(data.get(key) or {}, Mapping):
            raise SourceError(
                f"{file}: '{key}' must be a mapping; got {data[key]!r}.",
                f"write it as '{key}: {{NAME: VALUE}}', or leave it out",
            )
    for key in ("name", "spec"):
        if key not in data:
            raise SourceError(f"{file} has no '{key}'.", "see docs/guides/your-own-policy.md for a complete example")
    for key in ("name", "version"):
        _check_label(file, key, data.get(key, "0.0.0"))
    _check_timeout(file, data)
    spec = PolicySpec.from_dict(data["spec"])
    _check_labels(file, spec)
    program = program_from(data["program"]) if "program" in data else single_graph(spec)
    check_program(program, {step.graph for step in program}, spec)
    return Description(
        folder=file.parent,
        name=str(data["name"]),
        version=str(data.get("version", "0.0.0")),
        spec=spec,
        factory="" if (named := str(data.get("source", ""))) and is_file(file, named) else named,
        arguments=dict(data.get("arguments") or {}),
        program=program,
        environment=dict(data.get("environment") or {}),
        parts=dict(data.get("parts") or {}),
        calibration=_recording(file, data, "calibration"),
        evaluation=_recording(file, data, "evaluation"),
        maps={purpose: _map(file, data, purpose) for purpose in PURPOSES},
        description=str(data.get("description", "")),
        license=str(data.get("license", "")),
        weights=_weights(file, data.get("weights", "")),
        files=_files(file, data.get("files")),
        training=_training(file, data.get("training", "")),
        read_from=(file,),
    )


def is_file(described: Path, named: str) -> bool:
    """Return whether the ``source`` of a policy.yaml is a file that holds the policy, and no function.

    Args:
        described: the policy.yaml.
        named: what it names.
    """
    return bool(named) and ":" not in named and not named.endswith(".py") and (described.parent / named).exists()


def file_source(path: Path) -> tuple[Path, Path] | None:
    """Return a policy.yaml and the file or directory that it names as its source; None where it names none.

    Args:
        path: the policy.yaml, or the directory that holds it.
    """
    described = path / FILE if path.is_dir() else path
    if described.suffix not in (".yaml", ".yml") or not described.is_file():
        return None
    try:
        data = read_mapping(described, str(described), SourceError)
    except SourceError:  # whoever reads it as a policy says so
        return None
    named = data.get("source") if "spec" in data else None
    return (described, described.parent / named) if isinstance(named, str) and is_file(described, named) else None


def _check_label(file: Path, key: str, value: Any) -> None:
    """Refuse a name or version that could not stand in a line of a report."""
    label = str(value)
    if not (0 < len(label) <= MAX_LABEL_CHARACTERS and one_line(label, MAX_LABEL_CHARACTERS) == label):
        raise SourceError(
            f"{file}: '{key}' must be text of 1 to {MAX_LABEL_CHARACTERS} characters without control characters; got "
            f"{truncate(label, 40)!r}.",
            "give it a short name in one line",
        )


def _check_timeout(file: Path, data: Mapping[str, Any]) -> None:
    """Refuse an invalid timeout for calls of the environment."""
    seconds = (data.get("environment") or {}).get("timeout", 1)
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 < seconds <= 1e6:
        raise SourceError(
            f"{file}: 'timeout' under environment is {seconds!r:.60}; allowed: seconds above 0, up to 1,000,000.",
            "write it as timeout: 60, or leave it out",
        )


def _check_labels(file: Path, spec: PolicySpec) -> None:
    """Refuse two elements of one name: a controller could not tell them apart."""
    for tensor in (*spec.inputs, *spec.outputs):
        label, count = next(iter(Counter(tensor.labels).most_common(1)), ("", 0))
        if count > 1:
            raise SourceError(
                f"{file}: the labels of '{tensor.name}' name '{label}' {count} times; name each once.",
                "give each element a label of its own",
            )


def _files(file: Path, patterns: Any) -> tuple[str, ...] | None:
    """Globs inside the policy's folder."""
    if patterns is None:
        return None
    globs = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(globs, list) or not all(glob and _inside(glob) for glob in globs):
        raise SourceError(
            f"{file}: 'files' must be globs inside the folder, as [weights.pt]; got {patterns!r}.",
            "name files below the folder of the policy.yaml, or leave 'files' out",
        )
    return tuple(globs)


def _weights(file: Path, pattern: Any) -> str:
    """A glob inside the policy's folder."""
    if not _inside(pattern):
        raise SourceError(
            f"{file}: 'weights' must be a glob inside the folder, as \"*.safetensors\"; got {pattern!r}.",
            "write it as a glob below the folder of the policy.yaml, or leave it out",
        )
    return str(pattern)


def _training(file: Path, named: Any) -> str:
    """A function in a Python file of the policy's folder."""
    if named == "":
        return ""
    where, _, function = named.rpartition(":") if isinstance(named, str) else ("", "", "")
    if not (where.endswith(".py") and function.isidentifier() and _inside(where)):
        raise SourceError(
            f"{file}: 'training' must be a function in a file of the folder, as train.py:batches; got {named!r}.",
            "write it as FILE.py:FUNCTION, with the file beside the policy.yaml",
        )
    if not (file.parent / where).is_file():
        raise SourceError(
            f"{file} names the function {named} to train with; there is no file {where}.",
            "correct the name, or put the file there",
        )
    return str(named)


def _inside(pattern: Any) -> bool:
    """Return whether a pattern, which may be empty, is one that pathlib takes and that stays in its folder."""
    if not isinstance(pattern, str) or pattern.startswith("/") or len(pattern) > 1024 or "\0" in pattern:
        return False
    parts = pattern.split("/")
    whole = all(part == "**" or "**" not in part for part in parts) and all(len(part.encode()) <= 255 for part in parts)
    return whole and ".." not in parts and (not pattern or any(part not in ("", ".") for part in parts))


def write_location(out: Path, folder: Path) -> None:
    """Note where the policy's code is; the note is not part of the bundle's identity."""
    (out / LOCATION).write_text(json.dumps({"folder": str(folder.resolve())}) + "\n", encoding="utf-8")


def read_location(bundle: Path) -> Path:
    """Return the folder of the policy's code; raises SourceError when the bundle has no note, or the folder is gone."""
    try:
        folder = Path(json.loads((bundle / LOCATION).read_text(encoding="utf-8"))["folder"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise SourceError(
            f"{bundle} does not say where the policy's code is.", "start again from the source"
        ) from error
    if not folder.is_absolute() or ".." in folder.parts or "\0" in str(folder):
        raise SourceError(f"{bundle} notes {str(folder)!r} as the place of the code.", "start again from the source")
    if not folder.is_dir():
        raise SourceError(f"The policy's code was in {folder}, which is gone.", "start again from the source")
    return folder


def _recording(file: Path, data: Mapping[str, Any], key: str) -> Path | None:
    """Return the recording that is named, which must exist, or the one of the default name, if there is one."""
    named = data.get(key)
    if isinstance(named, Mapping):
        if unknown := sorted(map(str, {*named} - {"path", "map"})):
            raise SourceError(
                f"{file}: '{key}' has the unknown key '{unknown[0]}'; known: map, path.",
                f"write it as {key}: {{path: DATASET, map: {{NAME: RECORDED}}}}",
            )
        named = named.get("path")
    path = file.parent / str(named or f"{key}.npz")
    if named and not path.exists():
        raise SourceError(
            f"{file} names the {key} data {named}, which does not exist.",
            f"correct the path (it begins at {file.parent}), or leave '{key}' out",
        )
    return path if path.exists() else None


def _map(file: Path, data: Mapping[str, Any], key: str) -> dict[str, str]:
    """Return the names that a recording has for those of the spec, where they differ."""
    entry = data.get(key)
    names = (entry.get("map") if isinstance(entry, Mapping) else None) or {}
    if not isinstance(names, Mapping) or not all(isinstance(name, str) for pair in names.items() for name in pair):
        raise SourceError(
            f"{file}: 'map' of '{key}' must name the recording's name for each of the spec; got {names!r:.80}.",
            "write it as map: {NAME: RECORDED}, or leave it out",
        )
    return dict(names)


def copy_assets(described: Description, out: Path) -> None:
    """Copy tokenizers and statistics to ``assets/``.

    Raises:
        SourceError: when a file that the spec names is missing.
        SpecError: when statistics or a vocabulary do not fit the spec; names the user's file, not the copy.
    """
    for file in described.assets():
        name = file.relative_to(described.folder)
        if not file.is_file():
            raise SourceError(
                f"The spec names {name}, which is not in {described.folder}.",
                "put the file there, or correct its name in the spec",
            )
        target = out / "assets" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)
    check_assets(described, out / "assets")


def carry_recordings(described: Description, out: Path) -> None:
    """Put recorded data into ``data/`` of a bundle.

    Raises:
        DataError: when a recording cannot be read or does not fit the spec; names the user's file.
    """
    keeps = keeps_values(described.program)
    for purpose, path in described.recordings().items():
        recording = NamedRecording(path, described.maps.get(purpose, {}))
        carry_recording(recording, purpose, described.spec, out, keeps=keeps)


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
