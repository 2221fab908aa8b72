"""A policy package: ``manifest.json`` of the format ``policy_package``, an ONNX file, and statistics beside it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SourceError, suggest
from vlatool.files.json import read_json
from vlatool.files.limits import check_limit
from vlatool.files.validate import path_problem
from vlatool.module.description import FILE, Description, check_assets, copy_assets
from vlatool.registry import Claim
from vlatool.sources._graph_source import GraphSource
from vlatool.sources._onnx_files import load_onnx
from vlatool.sources._tensor_files import read_tensors
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

FORMAT = "policy_package"
MAX_BYTES = 1 << 20
STATISTICS = "statistics.json"
EPSILON = 1e-8
"""What the packages add to a spread before they divide by it."""
MODES = {"mean_std": "mean_std", "standard": "mean_std", "min_max": "min_max", "quantiles": "quantiles"}
KEYS = {"mean_std": ("mean", "std"), "min_max": ("min", "max"), "quantiles": ("q01", "q99")}
NORMALIZERS = {
    "normalize": "input", "denormalize": "output", "statsnormalizer": "input", "statsdenormalizer": "output"
}  # fmt: skip
"""Last word of the name of a component -> which end of the policy it changes."""
HARMLESS = ("singlepass", "single_pass", "actionchunking", "action_chunking", "totensor", "to_tensor")
"""Components that leave the values as they are."""
REPRESENTATIONS = {"absolute": "absolute", "delta": "delta", "relative": "relative", "velocity": "velocity"}
AS_GRAPH = "export the package with an ONNX artifact that holds that step, or describe its graph in a policy.yaml"


Normalised = tuple[str, tuple[str, str, dict[str, list[float]]]]
"""A feature, and the mode, the end (input or output) and the statistics by which it is normalised."""


class PolicyPackage(GraphSource):
    """A directory with a ``manifest.json`` of the format policy_package (physical-ai-studio): data, not code."""

    needs: ClassVar[str] = f"a directory with a {MANIFEST} of the format {FORMAT}"

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim a directory whose manifest is of that format."""
        file = Path(typed) / MANIFEST
        try:
            if not file.is_file() or file.stat().st_size > MAX_BYTES:
                return Claim.NONE
            data = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return Claim.NONE
        return Claim.CERTAIN if isinstance(data, Mapping) and data.get("format") == FORMAT else Claim.NONE

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a directory."""
        beside = Path(typed) / FILE
        return cls(model=Path(typed), policy=beside if beside.is_file() else None)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The manifest names one ONNX file, and steps that are known."""
        self._file()
        dict(self._normalised())

    def read(self, description: Description | None, context: Context) -> tuple[Any, Any]:
        """Load the ONNX file that the manifest names."""
        return load_onnx(self._file()), None

    def file(self) -> Path:
        """Return the ONNX file, which ONNX Runtime opens."""
        return self._file()

    def description_of(self, model: Any) -> Description:
        """Describe the policy by its graph, and by what the manifest says of statistics, names and the chunk."""
        plain, data = super().description_of(model), self._data()
        normalised = dict(self._normalised())
        known = {tensor.name for tensor in (*plain.spec.inputs, *plain.spec.outputs)}
        for name in normalised:
            if name not in known:
                raise SourceError(f"{self.model / MANIFEST} normalises '{name}'; {suggest(name, known)}.", AS_GRAPH)
        action = _mapping(data.get("action"))
        names = _orders(data)
        inputs = tuple(_enriched(each, normalised.get(each.name), names) for each in plain.spec.inputs)
        outputs = tuple(_enriched(each, normalised.get(each.name), names) for each in plain.spec.outputs)
        mode = REPRESENTATIONS.get(str(action.get("representation", "")), "")
        outputs = (replace(outputs[0], mode=mode), *outputs[1:])
        execute = action.get("n_action_steps") or plain.spec.execute
        spec = PolicySpec(
            inputs, outputs, self.control_hz, plain.spec.chunk, execute if isinstance(execute, int) else 0
        )
        name = str(_mapping(data.get("policy")).get("name") or self.model.resolve().name)
        return replace(plain, folder=self.model, name=name, spec=spec)

    def write_assets(self, described: Description, out: Path) -> None:
        """Write the statistics as numbers that the runtime reads."""
        if self.policy is not None:
            copy_assets(described, out)
            return
        table = {name: values for name, (_, _, values) in self._normalised()}
        if table:
            (out / "assets").mkdir(parents=True)
            (out / "assets" / STATISTICS).write_text(json.dumps(table, indent=1), encoding="utf-8")
        check_assets(described, out / "assets")

    def _data(self) -> dict[str, Any]:
        file = self.model / MANIFEST
        check_limit("manifest_bytes", file.stat().st_size, str(file), SourceError)
        data = read_json(file.read_bytes(), f"The manifest {file}", SourceError, "export the package again")
        if not isinstance(data, dict) or not str(data.get("version", "")).startswith("1."):
            version = data.get("version") if isinstance(data, dict) else None
            raise SourceError(f"{file} has the version {version!r}; this vlatool reads 1.x.", "upgrade vlatool")
        return data

    def _file(self) -> Path:
        """Return the only ONNX file of the artifacts.

        Raises:
            SourceError: naming the artifacts where there is none, or several.
        """
        data = self._data()
        artifacts = _mapping(data.get("artifacts")) or _mapping(_mapping(data.get("model")).get("artifacts"))
        files = [str(file) for file in artifacts.values() if str(file).endswith(".onnx")]
        where = self.model / MANIFEST
        if len(files) != 1:
            listed = ", ".join(map(str, artifacts.values())) or "none"
            raise SourceError(
                f"{where} names {'several graphs' if files else 'no ONNX file'} (artifacts: {listed}).",
                "export the package for ONNX, as one graph; steps that a runner repeats belong into the program of a "
                "policy.yaml",
            )
        if problem := path_problem(files[0]):
            raise SourceError(f"{where} names the file {files[0]!r}: {problem}.", "export the package again")
        if not (self.model / files[0]).is_file():
            raise SourceError(f"{where} names {files[0]}, which is not there.", "copy the whole directory again")
        return self.model / files[0]

    def _normalised(self) -> Iterator[Normalised]:
        """Yield feature, and its mode, its end and its statistics as the runtime applies them.

        Raises:
            SourceError: for a step that is not known, and for statistics that are missing.
        """
        data = self._data()
        model = _mapping(data.get("model"))
        if data.get("inference"):
            raise SourceError(
                f"{self.model / MANIFEST} asks for a loop of its own around the graph (inference).",
                "write the loop as the program of a policy.yaml beside it",
            )
        for component in (
            model.get("runner"),
            *(model.get("preprocessors") or ()),
            *(model.get("postprocessors") or ()),
        ):
            yield from self._of_component(_mapping(component)) if component else ()
        if about := _mapping(data.get("normalization")):
            for key, end in (("input_features", "input"), ("output_features", "output")):
                if features := about.get(key):
                    yield from self._features(about.get("type"), about.get("artifact"), features, end)

    def _of_component(self, component: Mapping[str, Any]) -> Iterator[Normalised]:
        options = {**component, **_mapping(component.get("init_args"))}
        kind = str(component.get("class_path") or component.get("type") or "").rpartition(".")[2].lower()
        if kind in HARMLESS:
            return
        if kind not in NORMALIZERS:
            raise SourceError(
                f"{self.model / MANIFEST} has the step '{component.get('class_path') or component.get('type')}', which "
                f"is code of its own; known: {', '.join(NORMALIZERS)}.",
                AS_GRAPH,
            )
        artifact = options.get("artifact") or options.get("stats_path")
        yield from self._features(
            options.get("mode", "mean_std"), artifact, options.get("features") or [], NORMALIZERS[kind]
        )

    def _features(self, mode: Any, artifact: Any, features: list[Any], end: str) -> Iterator[Normalised]:
        if mode == "identity":
            return
        where = self.model / MANIFEST
        if mode not in MODES:
            raise SourceError(f"{where} normalises by {mode!r}; {suggest(str(mode), list(MODES))}.", AS_GRAPH)
        if problem := path_problem(str(artifact)):
            raise SourceError(f"{where} names the statistics {artifact!r}: {problem}.", "export the package again")
        stored = read_tensors(self.model / str(artifact))
        names = [str(name) for name in features] or sorted({_split(key)[0] for key in stored} & self._ends(end))
        for name in names:
            yield name, (MODES[mode], end, self._statistics(name, MODES[mode], end, stored, str(artifact)))

    def _ends(self, end: str) -> set[str]:
        """Return the names of the graph's inputs, or of its outputs."""
        graph = load_onnx(self._file()).graph
        return {value.name for value in (graph.input if end == "input" else graph.output)}

    def _statistics(
        self, name: str, mode: str, end: str, stored: Mapping[str, NDArray[Any]], artifact: str
    ) -> dict[str, list[float]]:
        """Return the two statistics of a feature, with what is added to a spread before it divides."""
        found = {_split(key): np.asarray(value, np.float64).reshape(-1) for key, value in stored.items()}
        low, high = KEYS[mode]
        for key in (low, high):
            if (name, key) not in found:
                raise SourceError(
                    f"{self.model / artifact} lacks '{key}' of '{name}', by which it is normalised; it has "
                    f"{', '.join(sorted(stored)[:8])}.",
                    "export the package with the statistics of the training data",
                )
        if not np.all(found.get((name, "mask"), True)):
            raise SourceError(f"{self.model / artifact} leaves out elements of '{name}' (mask).", AS_GRAPH)
        first, second = found[name, low], found[name, high]
        if end == "input" and mode != "quantiles":
            second = second + EPSILON
        spread = second if mode == "mean_std" else second - first
        second = np.where(spread == 0, second + EPSILON, second)
        return {low: first.tolist(), high: second.tolist()}


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _split(key: str) -> tuple[str, str]:
    """Return feature and statistic of ``FEATURE/mean``, or ``FEATURE.mean``."""
    feature, _, statistic = key.rpartition("/" if "/" in key else ".")
    return feature, statistic


def _orders(data: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return feature -> names of its elements, where there is one robot, whose joints are named."""
    robots = _mapping(data.get("hardware")).get("robots") or []
    if len(robots) != 1:
        return {}
    robot = _mapping(robots[0])
    ends = {"action": _mapping(robot.get("action")), "state": _mapping(robot.get("state"))}
    return {name: tuple(map(str, end.get("order") or ())) for name, end in ends.items()}


def _enriched(tensor: TensorSpec, normalised: Any, names: Mapping[str, tuple[str, ...]]) -> TensorSpec:
    labels = names.get(tensor.name.rpartition(".")[2], ())
    tensor = replace(tensor, labels=labels if len(labels) == tensor.width else ())
    if normalised is None:
        return tensor
    return replace(tensor, normalisation=normalised[0], statistics=f"{STATISTICS}#{tensor.name}")
