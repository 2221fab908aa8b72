"""A LEAPP bundle: ONNX files and a YAML file that says how they feed each other, as Isaac Lab and GR00T export it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SourceError, suggest
from vlatool.files.validate import path_problem
from vlatool.files.yaml import read_mapping
from vlatool.machine.engine_calls import engine_call
from vlatool.module.description import FILE, Description
from vlatool.registry import Claim
from vlatool.runtime.engine import engine_class
from vlatool.sources._graph_source import GraphSource
from vlatool.sources._onnx_pipeline import Chain, Pipeline, in_order
from vlatool.sources._tensor_files import read_tensors
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

PARTS = ("models", "pipeline", "system information")
"""Keys of the YAML file, at the beginning of lines."""
MAX_BYTES = 256 << 10
EXPORT_AGAIN = "export the bundle again where it was made, and copy its whole directory"
MODES = {"position": "absolute", "pose": "absolute", "orientation": "absolute", "velocity": "velocity"}
"""Last word of the kind of a target -> how a controller applies it."""


class LeappBundle(GraphSource):
    """A LEAPP bundle of ONNX files: read, never executed; what its graphs remember is kept by the program."""

    needs: ClassVar[str] = "a LEAPP bundle: a directory with its YAML file, or that file"

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim a YAML file with the parts of LEAPP, and a directory that holds one."""
        return Claim.CERTAIN if _files(Path(typed)) else Claim.NONE

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for the YAML file, or the only one in a directory.

        Raises:
            SourceError: when there are several.
        """
        files = _files(Path(typed))
        if len(files) != 1:
            names = ", ".join(map(str, files)) or "none"
            raise SourceError(f"{typed} holds several LEAPP bundles: {names}.", "name one of these files")
        beside = files[0].parent / FILE
        return cls(model=files[0], policy=beside if beside.is_file() else None)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The YAML file describes ONNX files that are there and are those that were exported."""
        self._pipeline()

    def inputs(self) -> tuple[Path, ...]:
        """The bundle's files, and what a description names."""
        listed = [path for path in self.model.parent.rglob("*") if path.suffix in (".onnx", ".data", ".safetensors")]
        return (*sorted(listed), *super().inputs())

    def read(self, description: Description | None, context: Context) -> tuple[Any, Any]:
        """Join the graphs; the reference is each graph in a session of its own."""
        pipeline = self._pipeline()
        with engine_call(engine_class(), f"opened the graphs of {self.model.name}"):
            return pipeline.merge(), Chain(pipeline)

    def description_of(self, model: Any) -> Description:
        """Describe the policy by its graphs and by what the YAML file says of kinds, names and the rate."""
        pipeline, data = self._pipeline(), self._data()
        plain = super().description_of(model)
        memories = {**pipeline.feedback}
        about = {**self._about(pipeline.inputs, "inputs"), **self._about(pipeline.outputs, "outputs")}
        tensors = {tensor.name: _enriched(tensor, about.get(tensor.name, {})) for tensor in plain.spec.inputs}
        given = {tensor.name: _enriched(tensor, about.get(tensor.name, {})) for tensor in plain.spec.outputs}
        inputs = tuple(tensors[name] for name in pipeline.inputs.values())
        outputs = tuple(given[name] for name in pipeline.outputs.values())
        rate = self.control_hz or (data["pipeline"].get("configs") or {}).get("frequency")
        spec = PolicySpec(inputs, outputs, float(rate) if rate else None, plain.spec.chunk, plain.spec.execute)
        kept = {name: {"shape": list(tensors[name].shape), "dtype": tensors[name].dtype} for name in memories}
        feeds = {name: name for name in (*(tensor.name for tensor in inputs), *memories)}
        gives = {tensor.name: tensor.name for tensor in outputs} | {after: name for name, after in memories.items()}
        return replace(plain, spec=spec, program=(ProgramStep("main", feeds, gives, keep=kept),))

    def _data(self) -> dict[str, Any]:
        data = read_mapping(self.model, str(self.model), SourceError)
        for key in PARTS[:2]:
            if not isinstance(data.get(key), Mapping):
                raise SourceError(f"{self.model} has no '{key}'; a LEAPP bundle has {', '.join(PARTS)}.", EXPORT_AGAIN)
        return dict(data)

    def _about(self, ends: Mapping[str, str], key: str) -> dict[str, Mapping[str, Any]]:
        """Return name outside -> what the YAML file says of it."""
        models = self._data()["models"]
        said = {f"{name}/{entry.get('name')}": entry for name, model in models.items() for entry in model[key]}
        return {name: said.get(source, {}) for source, name in ends.items()}

    def _pipeline(self) -> Pipeline:
        """Return the pipeline that the YAML file describes.

        Raises:
            SourceError: naming what is missing, changed, or of another backend.
        """
        data = self._data()
        models, pipeline = data["models"], data["pipeline"]
        files = {name: self._file(name, model) for name, model in models.items()}
        flows = self._targets(pipeline, "data_flow")
        memories = self._targets(pipeline, "feedback_flow")
        inputs, outputs = self._ends(pipeline, "inputs"), self._ends(pipeline, "outputs")
        ordered = {name: files[name] for name in in_order(list(files), flows)}
        initial = self._initial(pipeline, memories)
        return Pipeline(ordered, flows, memories, inputs, outputs, initial)

    def _file(self, name: str, model: Any) -> Path:
        if not isinstance(model, Mapping) or not all(isinstance(model.get(key), list) for key in ("inputs", "outputs")):
            raise SourceError(f"{self.model} describes the graph '{name}' without inputs and outputs.", EXPORT_AGAIN)
        about = model.get("parameters")
        about = about if isinstance(about, Mapping) else {}
        backend, relative = about.get("backend", "none"), str(about.get("model_path", ""))
        if backend != "onnx":
            raise SourceError(
                f"{self.model} has the graph '{name}' for the backend '{backend}'; allowed: onnx.",
                'export it with export_with="onnx"',
            )
        if about.get("warp_segments"):
            raise SourceError(
                f"The graph '{name}' of {self.model} holds {about['warp_segments']} kernels of Warp, which LEAPP "
                "alone runs.",
                "export the policy without them",
            )
        if problem := path_problem(relative):
            raise SourceError(f"{self.model} names the file {relative!r} of '{name}': {problem}.", EXPORT_AGAIN)
        file = self.model.parent / relative
        if not file.is_file():
            raise SourceError(f"{self.model} names {relative}, which is not beside it.", EXPORT_AGAIN)
        if about.get("sha256sum") and hash_file(file) != about["sha256sum"]:
            raise SourceError(
                f"{file} is not the file that {self.model.name} describes: its SHA-256 differs.", EXPORT_AGAIN
            )
        return file

    def _targets(self, pipeline: Mapping[str, Any], key: str) -> dict[str, str]:
        flows = pipeline.get(key) or {}
        if not isinstance(flows, Mapping) or not all(isinstance(targets, list) for targets in flows.values()):
            raise SourceError(
                f"{self.model} has '{key}' that is not a mapping of outputs to lists of inputs.", EXPORT_AGAIN
            )
        return {str(target): str(source) for source, targets in flows.items() for target in targets}

    def _ends(self, pipeline: Mapping[str, Any], key: str) -> dict[str, str]:
        """Return ``GRAPH/NAME`` -> its name outside: the name alone where no other graph has it."""
        ends = pipeline.get(key)
        if not isinstance(ends, Mapping) or not any(ends.values()):
            raise SourceError(f"{self.model} names no {key} of the pipeline.", EXPORT_AGAIN)
        pairs = [(str(graph), str(name)) for graph, names in ends.items() for name in names or ()]
        names = [name for _, name in pairs]
        return {f"{graph}/{name}": name if names.count(name) == 1 else f"{graph}.{name}" for graph, name in pairs}

    def _initial(self, pipeline: Mapping[str, Any], memories: Mapping[str, str]) -> dict[str, NDArray[Any]]:
        """Return the memories that begin with other values than zero."""
        named = pipeline.get("initial_values")
        if not named:
            return {}
        if problem := path_problem(str(named)):
            raise SourceError(f"{self.model} names the file {named!r}: {problem}.", EXPORT_AGAIN)
        values = read_tensors(self.model.parent / str(named))
        for name in values.keys() - memories.keys():
            raise SourceError(
                f"{named} holds '{name}', which is not a memory; {suggest(name, list(memories))}.", EXPORT_AGAIN
            )
        return {name: value for name, value in values.items() if np.any(value)}


def _files(path: Path) -> list[Path]:
    """Return the YAML files of LEAPP that a path is or holds."""
    if path.is_dir():
        return [file for file in sorted(path.glob("*.yaml"))[:16] if file.name != FILE and _files(file)]
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        return []
    try:
        with path.open("rb") as stream:
            text = b"\n" + stream.read(MAX_BYTES)
    except OSError:
        return []
    return [path] if all(f"\n{part}:".encode() in text for part in PARTS) else []


def _enriched(tensor: TensorSpec, about: Mapping[str, Any]) -> TensorSpec:
    """Return a tensor with the labels and the mode that LEAPP says."""
    names = about.get("element_names")
    last = names[-1] if isinstance(names, list) and names else None
    labels = tuple(map(str, last)) if isinstance(last, list) and len(last) == tensor.width else ()
    kind = str(about.get("kind") or "")
    mode = MODES.get(kind.rpartition("/")[2], "") if kind.startswith("target/") else ""
    return replace(tensor, labels=labels, mode=mode)
