"""``manifest.json``: what a bundle contains, and how its graphs are run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

from vlatool.bundle.program import ProgramStep, check_graph_name, check_program, program_from, slow_part
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import BundleError
from vlatool.files.limits import check_limit
from vlatool.files.messages import field_values, to_json
from vlatool.files.validate import finite_number, integer, mapping, path_problem, sequence, short_repr, text

SCHEMA = 3
"""The newest version; a manifest has the first one that has all that it says, so that older readers take it."""
GOLDEN_TOLERANCE = 0.05
"""Allowed relative L2 difference from the golden action if the manifest does not set one."""
COMPUTES = ("", "float32", "bfloat16")
SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class FileRecord:
    """Size in bytes and SHA-256 (hex) of one file of a bundle."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class Graph:
    """One ONNX file of a policy.

    Args:
        file: path inside the bundle.
        precision: share of the multiply-accumulates that run in each dtype, as exported (0-1); ``int4 weights`` if
            only the weights are int4.
        opset: opset of the default ONNX domain.
        compute: dtype in which the engine computes what is not quantized: ``bfloat16``, or float32 when empty.
    """

    file: str
    precision: dict[str, float] = field(default_factory=dict)
    opset: int = 0
    compute: str = ""

    def __post_init__(self) -> None:
        _inside(self.file)
        for name, share in mapping(self.precision, f"The precision of {self.file}", BundleError).items():
            if not 0 <= finite_number(share, f"The share of {name} in {self.file}", BundleError) <= 1.001:
                raise BundleError(f"The share of {name} in {self.file} is {short_repr(share)}; allowed: 0 to 1.")
        integer(self.opset, f"The opset of {self.file}", BundleError)
        if self.compute not in COMPUTES:
            raise BundleError(
                f"The graph {self.file} computes in {short_repr(self.compute)}; allowed: {', '.join(COMPUTES[1:])}."
            )


@dataclass(frozen=True)
class Manifest:
    """The content of ``manifest.json``.

    Args:
        name: name of the policy.
        version: version of the policy, assigned by its author.
        spec: what the policy consumes and produces.
        graphs: graph name -> graph; empty in a source bundle.
        program: how the graphs are run, in order.
        files: path inside the bundle -> SHA-256 and size, for every file except the reports.
        parent: ``sha256:...`` of the bundle that this one was made from.
        made_by: version of vlatool, stage, options, and versions of the packages that affect the result.
        build: build record: for each stage from the source to this bundle, the content of ``made_by``, the seed, the
            hash of its input, and the SHA-256 of its graphs, its input files and its calibration samples.
        source: factory and hashes of code and weights (in a source bundle, and in those exported from it).
        environment: factory and tasks of the closed-loop evaluation.
        parts: part of the policy -> globs of module names.
        golden: file with golden inputs and outputs; the outputs are the graphs' reference results, computed operator by
            operator.
        golden_tolerance: largest relative L2 difference from the golden action with which a machine loads the bundle,
            derived from the difference measured when it was made; ``GOLDEN_TOLERANCE`` when 0.
        golden_chunk_tolerance: the same for the action in physical units, each element from the offset of its
            statistics and in units of their spread; ``golden_tolerance`` when 0.
        findings: problems that a stage found: ``name``, ``message`` and the measured values. ``load``, ``optimize``
            and ``gate`` refuse the bundle unless each finding is accepted by name.
        accuracy: measured accuracy: name -> value, interval, samples.
        description: one sentence.
        license: SPDX identifier of the policy's licence.
        engine: engine that the graphs were made for; ONNX Runtime on the CPU when empty.
        schema: version of this format: 3 with a ``slow`` part in the program, 2 with an ``image``, an ``epsilon`` or
            ``quantile10``, else 1.
    """

    name: str
    version: str
    spec: PolicySpec
    graphs: dict[str, Graph] = field(default_factory=dict)
    program: tuple[ProgramStep, ...] = ()
    files: dict[str, FileRecord] = field(default_factory=dict)
    parent: str = ""
    made_by: dict[str, Any] = field(default_factory=dict)
    build: tuple[dict[str, Any], ...] = ()
    source: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)
    parts: dict[str, list[str]] = field(default_factory=dict)
    golden: str = ""
    golden_tolerance: float = 0.0
    golden_chunk_tolerance: float = 0.0
    findings: tuple[dict[str, Any], ...] = ()
    accuracy: dict[str, Any] = field(default_factory=dict)
    description: str = ""
    license: str = ""
    engine: str = ""
    schema: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "schema", max(self.schema, self.spec.schema, _program_schema(self.program)))
        check_limit("files", len(self.files), "The manifest", BundleError)
        check_limit("graphs", len(self.graphs), "The manifest", BundleError)
        for path in (*self.files, *(graph.file for graph in self.graphs.values())):
            _inside(path)
        for name in self.graphs:
            check_graph_name(name, BundleError)
        for graph in self.graphs.values():
            if graph.file not in self.files:
                raise BundleError(f"The manifest names the graph {graph.file}, but records no hash for it.")
        if self.graphs and not self.program:
            raise BundleError(f"The manifest has graphs, but no program that runs them to '{self.spec.action.name}'.")
        for name, measured in self.accuracy.items():
            if not isinstance(measured, Mapping) or "value" not in measured:
                raise BundleError(
                    f"The manifest's accuracy '{name}' must have a number as 'value'; got {short_repr(measured)}."
                )
            finite_number(measured["value"], f"The manifest's accuracy '{name}'", BundleError)
        if self.program:
            check_program(self.program, self.graphs or {step.graph: None for step in self.program}, self.spec)

    @classmethod
    def from_dict(cls, data: Any) -> Manifest:
        """Build a manifest from the parsed JSON.

        Raises:
            BundleError: for a newer schema, a missing key or a wrong type.
            SpecError: for an impossible spec or program.
        """
        check_schema(mapping(data, "The manifest", BundleError).get("schema"))
        values = field_values(cls, data, "The manifest", BundleError)
        for item in fields(cls):
            if item.name in values:
                _check_type(item.name, values[item.name], item)
        for key in ("name", "version", "spec"):
            if key not in values:
                raise BundleError(f"The manifest has no '{key}'.", "export the policy again")
        check_limit("files", len(values.get("files", ())), "The manifest", BundleError)
        values["spec"] = PolicySpec.from_dict(values["spec"])
        if values["spec"].schema > values["schema"]:
            raise BundleError(
                f"The manifest has the schema {values['schema']}, but what begins with "
                f"{values['spec'].schema}, such as 'image', 'history', 'epsilon', 'parts' or 'convert'."
            )
        values["graphs"] = {name: _graph(name, graph) for name, graph in values.get("graphs", {}).items()}
        values["program"] = program_from(values.get("program", []))
        if (needed := _program_schema(values["program"])) > values["schema"]:
            raise BundleError(
                f"The manifest has the schema {values['schema']}, but a program with 'slow', which begins with "
                f"{needed}."
            )
        values["build"] = _entries(values.get("build", ()), "build", ("stage",))
        values["findings"] = _entries(values.get("findings", ()), "findings", ("name", "message"))
        values["files"] = {path: _record(path, record) for path, record in values.get("files", {}).items()}
        for part, globs in values.get("parts", {}).items():
            for glob in sequence(globs, f"The part '{part}' of the manifest", BundleError):
                text(glob, f"A glob of the part '{part}'", BundleError)
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """Return a mapping that ``from_dict`` turns back into an equal manifest; defaults are left out."""
        plain: dict[str, Any] = {"schema": self.schema, **to_json(self, defaults=False)}
        plain |= {"graphs": plain.get("graphs", {}), "program": plain.get("program", [])}
        return plain | {"files": dict(sorted(plain.get("files", {}).items()))}


def check_files(manifest: Manifest) -> None:
    """Check that every file that the manifest names has a record: golden file, statistics and tokenizers.

    Raises:
        BundleError: naming the first file without one.
    """
    named = {manifest.golden: "the golden file"} if manifest.golden else {}
    for tensor in (*manifest.spec.inputs, *manifest.spec.outputs) if manifest.graphs else ():
        for file in tensor.assets():
            named[f"assets/{file}"] = f"which '{tensor.name}' needs"
    for path, what in named.items():
        if path not in manifest.files:
            raise BundleError(f"The manifest names {path}, {what}, but records no hash for it.", "export it again")


def check_schema(schema: Any) -> None:
    """Check the version of a manifest; raises BundleError when it is not one, or newer than this vlatool supports."""
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise BundleError(f"The manifest has the schema {short_repr(schema)}; this vlatool reads 1 to {SCHEMA}.")
    if schema > SCHEMA:
        raise BundleError(
            f"The bundle has the manifest schema {short_repr(schema)}; this vlatool reads up to {SCHEMA}.",
            "upgrade vlatool",
        )


def _program_schema(program: Iterable[ProgramStep]) -> int:
    """Return the first version that has all that a program says."""
    return 1 if slow_part(program) is None else 3


def _check_type(name: str, value: Any, item: Any) -> None:
    """Check a value against the type of its field's default: text, a mapping or a list."""
    where = f"The manifest's '{name}'"
    if name in ("spec", "schema"):
        return
    if name in ("golden_tolerance", "golden_chunk_tolerance"):
        if finite_number(value, where, BundleError) < 0:
            raise BundleError(f"{where} is {short_repr(value)}; allowed: a number from 0.")
        return
    if item.default == "" or (item.default is MISSING and item.default_factory is MISSING):
        text(value, where, BundleError, empty=item.default == "")
    elif item.default_factory is dict:
        mapping(value, where, BundleError)
    elif name != "program":
        sequence(value, where, BundleError)


def _graph(name: str, data: Any) -> Graph:
    values = field_values(Graph, data, f"The graph '{name}'", BundleError)
    if "file" not in values:
        raise BundleError(f"The graph '{name}' has no 'file'.", "export the policy again")
    return Graph(**values)


def _record(path: str, data: Any) -> FileRecord:
    values = field_values(FileRecord, data, f"The record of {short_repr(path)}", BundleError)
    digest = values.get("sha256")
    if not isinstance(digest, str) or not SHA256.fullmatch(digest):
        raise BundleError(f"The record of {short_repr(path)} has the SHA-256 {short_repr(digest)}, not 64 hex digits.")
    return FileRecord(digest, integer(values.get("bytes"), f"The size of {short_repr(path)}", BundleError))


def _inside(path: Any) -> None:
    if not isinstance(path, str):
        raise BundleError(f"The manifest names the file {short_repr(path)} in graphs or files; a file is text.")
    if reason := path_problem(path):
        raise BundleError(f"The manifest names the file {short_repr(path)}, which is not inside the bundle: {reason}.")


def _entries(data: Any, where: str, keys: tuple[str, ...]) -> tuple[dict[str, Any], ...]:
    """Return a list of mappings that have text under each of the keys."""
    whole_list = isinstance(data, list | tuple) and all(
        isinstance(entry, Mapping) and all(isinstance(entry.get(key), str) for key in keys) for entry in data
    )
    if not whole_list:
        named = " and ".join(f"'{key}'" for key in keys)
        raise BundleError(f"The manifest has a malformed '{where}'; it must be a list of mappings with {named}.")
    return tuple(dict(entry) for entry in data)
