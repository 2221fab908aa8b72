"""A policy that is one ONNX file already."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import observations_for
from vlatool.errors import GraphError, InputError, SourceError, nearest, require
from vlatool.graph.draws import refuse_drawing_file
from vlatool.graph.precision import precision_shares
from vlatool.machine.risky import risky
from vlatool.module.description import FILE, Description, copy_assets, description_file, read_description
from vlatool.runtime.engine import engine_class
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.policy import relative_error
from vlatool.runtime.program import Program
from vlatool.sources._onnx_axes import axes_text, fix_axes, opset_of, with_opset
from vlatool.sources._onnx_batch import add_batch_axes
from vlatool.sources._source import Source
from vlatool.stage.base import Context
from vlatool.stage.finish import SEED, finish

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

TOLERANCE = 1e-3
"""Largest relative L2 difference between a file and what it was converted to."""
DTYPE_OF = {1: "float32", 2: "uint8", 6: "int32", 7: "int64", 9: "bool", 10: "float16"}
"""ONNX element type -> dtype of a spec."""


class OnnxFile(Source):
    """A policy that is one ONNX file; the spec comes from a description, or from the file's inputs and outputs."""

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")
    has_graphs: ClassVar[bool] = True
    runs_graphs: ClassVar[bool] = True

    model: Path = Field(description="the ONNX file; external data is found beside it")
    policy: Path | None = Field(
        None, description="policy.yaml with spec and assets; the file's own shapes when not given"
    )
    opset: int | None = Field(None, ge=7, le=23, description="convert the default ONNX domain to this opset")
    control_hz: float = Field(10.0, gt=0, description="rate of the control loop when there is no policy.yaml, in Hz")

    @classmethod
    def accepting(cls, typed: str) -> Self | None:
        """Take a .onnx file; point out the file where a directory holds one and names no factory."""
        path = Path(typed)
        if path.is_dir():
            _refuse_bare(path)
        if path.suffix != ".onnx" or path.is_dir():
            return None
        beside = path.parent / FILE
        return cls(model=path, policy=beside if beside.is_file() else None)

    def as_recorded(self, entry: Mapping[str, Any], bundle: Bundle) -> Self:
        """Convert to the opset of the record, where it has one."""
        opset = entry.get("options", {}).get("opset")
        return self.model_copy(update={"opset": opset}) if isinstance(opset, int) else self

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The file exists."""
        if not self.model.is_file():
            raise SourceError(f"No such ONNX file: {self.model}.")

    def inputs(self) -> tuple[Path, ...]:
        """The model, its external data and what the description names."""
        beside = sorted(self.model.parent.glob(self.model.name + "*"))
        if self.policy is None:
            return tuple(beside)
        described = read_description(self.policy)
        return (*beside, *described.recordings().values(), description_file(self.policy), *described.assets())

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Load the file, store it, and run it once."""
        self.check(None, None)
        model = _load(self.model)
        description = _description(self.policy) if self.policy else None
        fixed = axes_text(fix_axes(model, description.spec if description else None))
        further = [] if description else add_batch_axes(model)
        if further:
            axes = f"{', '.join(further)} of the file have no batch axis: one of 1 is put in front"
            fixed = f"{fixed}; {axes}" if fixed else axes
        if fixed:
            context.tell(fixed, None)
        described = description or self._described(model)
        _check_names(model, described.spec)
        refuse_drawing_file(model, self.model)
        if self.opset is not None:
            model = with_opset(model, self.opset)
        copy_assets(described, out)
        (out / "graphs").mkdir()
        onnx = require("onnx", "build")
        large = model.ByteSize() > 1_500_000_000
        onnx.save(model, str(out / "graphs/main.onnx"), save_as_external_data=large, location="main.onnx.data")
        manifest = described.manifest(program=described.program or single_graph(described.spec))
        converted = {"opset": self.opset} if self.opset is not None else {}
        made_by = {**self.made_by(), "options": {"model": self.model.name, **converted}}
        with _named_after(self.model, out / "graphs/main.onnx"):
            graphs = {"main": Graph("graphs/main.onnx", precision_shares(out / "graphs/main.onnx"), opset_of(model))}
            observations = observations_for(seal(out, manifest), 2)
            if converted:
                _compare(self.model, out, manifest, observations, further)
            return finish(Bundle(out, manifest), out, made_by=made_by, graphs=graphs, observations=observations)

    def _described(self, model: Any) -> Description:
        initializers = {tensor.name for tensor in model.graph.initializer}
        inputs = tuple(_tensor(value) for value in model.graph.input if value.name not in initializers)
        outputs = tuple(_tensor(value) for value in model.graph.output)
        rows = math.prod(axis for axis in outputs[0].shape[:-1] if isinstance(axis, int)) if outputs else 1
        spec = PolicySpec(inputs, outputs, self.control_hz, chunk=rows, execute=1 if rows > 1 else 0)
        return Description(self.model.parent, self.model.stem, "0.0.0", spec)


def _description(path: Path) -> Description:
    """Read a description whose program runs the one graph that an ONNX file is."""
    described = read_description(path)
    further = next((step.graph for step in described.program if step.graph != "main"), None)
    if further is not None:
        raise SourceError(
            f"The program in {path} runs the graph '{further}'; a policy that is one ONNX file only has the graph "
            "'main'.",
            "write graph: main in each step, or leave the program out",
        )
    return described


def _load(path: Path) -> Any:
    onnx = require("onnx", "build")
    try:
        model = onnx.load(str(path))
    except Exception as error:  # the seam: protobuf and onnx raise many foreign types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise SourceError(f"{path} is not a readable ONNX file: {reason}.") from error
    if not model.graph.node:
        raise SourceError(f"{path} is not an ONNX model: its graph has no nodes.")
    return model


def _tensor(value: Any) -> TensorSpec:
    kind = value.type.tensor_type
    if kind.elem_type not in DTYPE_OF:
        raise SourceError(
            f"'{value.name}' has the ONNX type {kind.elem_type}; allowed: {', '.join(DTYPE_OF.values())}."
        )
    axes = [axis.dim_value if axis.HasField("dim_value") else (axis.dim_param or "n") for axis in kind.shape.dim]
    if axes and isinstance(axes[0], str):
        axes[0] = 1
    if math.prod(axis for axis in axes if isinstance(axis, int)) < 1 or not axes:
        raise SourceError(f"'{value.name}' has the shape {axes}; a policy needs at least one axis of 1 or more.")
    return TensorSpec(value.name, tuple(axes), DTYPE_OF[kind.elem_type])


def _check_names(model: Any, spec: PolicySpec) -> None:
    for tensors, values in ((spec.inputs, model.graph.input), (spec.outputs, model.graph.output)):
        names = [value.name for value in values]
        for tensor in tensors:
            if tensor.name not in names:
                raise SourceError(
                    f"The ONNX file has no '{tensor.name}', which the spec names; {nearest(tensor.name, names)}."
                )


@contextlib.contextmanager
def _named_after(model: Path, copy: Path) -> Iterator[None]:
    """Report what is wrong with a copy by the user's own file: the copy is gone by the time they read it."""
    try:
        yield
    except InputError as error:
        error.message = error.message.replace(str(copy), str(model))
        if isinstance(error, GraphError) and not error.fix:
            error.fix = "fix the file where it was made; onnx.checker.check_model(FILE, full_check=True) may say more"
        raise


def _compare(
    before: Path, out: Path, manifest: Manifest, observations: list[dict[str, Any]], unbatched: list[str]
) -> None:
    """Compare the converted graph with the file that it came from, which has no batch axis in some tensors.

    Raises:
        SourceError: when ONNX Runtime computes something else.
    """
    programs = []
    for path in (before, out / "graphs/main.onnx"):
        with risky(engine_class(), f"opened {path.name}"):
            programs.append(Program(manifest.program, {"main": engine_class()(path, threads=1)}, SEED))
    encode = ObservationEncoder(manifest.spec, out / "assets")
    for observation in observations:
        feeds = encode(observation)
        as_before = {name: value[0] if name in unbatched else value for name, value in feeds.items()}
        expected, got = (
            program.run(inputs)[manifest.spec.action.name]
            for program, inputs in zip(programs, (as_before, dict(feeds)), strict=True)
        )
        error = relative_error(got, expected)
        if not error <= TOLERANCE:
            raise SourceError(
                f"Converted to another opset, the ONNX file computes something else: relative L2 error {error:.3g}, "
                f"allowed {TOLERANCE:g}.",
                "leave --opset out, or export the file again where it was made",
            )


def _refuse_bare(folder: Path) -> None:
    """Refuse a directory that holds ONNX files and names no factory: the file itself is the source.

    Raises:
        SourceError: naming the file, or all of them.
    """
    files = sorted(folder.glob("*.onnx"))
    described = (folder / FILE).is_file()
    if not files or (described and read_description(folder).factory):
        return
    names = ", ".join(str(file) for file in files[:4])
    lacks = f"a {FILE} without a 'source'" if described else f"no {FILE}"
    beside = "" if described else f"; a {FILE} beside it may describe inputs and outputs"
    raise SourceError(
        f"{folder} holds ONNX files ({', '.join(file.name for file in files[:4])}) and {lacks}.",
        f"name the file: {names if len(files) == 1 else f'one of {names}'}{beside}",
    )
