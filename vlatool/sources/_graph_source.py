"""A policy that is one graph: what its sources have in common, whatever wrote the file."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import PURPOSES, observations_for
from vlatool.errors import GraphError, InputError, SourceError, suggest
from vlatool.graph.files import save
from vlatool.graph.float32_conversion import ROUNDING, as_float32, describe_conversion
from vlatool.graph.layers import MIN_OPSET
from vlatool.graph.onnx_graph import type_name
from vlatool.graph.random_ops import refuse_random_file
from vlatool.machine.engine_calls import REMEDY, engine_call
from vlatool.module.description import FILE, Description, carry_recordings, copy_assets, read_description
from vlatool.module.source import Source
from vlatool.runtime.engine import engine_class
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.policy import relative_error
from vlatool.runtime.program import Program
from vlatool.sources._onnx_axes import axes_text, fix_axes, opset_of, shapes_from, with_opset
from vlatool.sources._onnx_batch import add_batch_axes
from vlatool.sources._onnx_ends import complete_outputs, refuse_types
from vlatool.sources._onnx_files import WHERE_MADE
from vlatool.sources._onnx_plain import plain
from vlatool.stage.base import Context, Result
from vlatool.stage.finish import SEED, finish
from vlatool.stage.precision_shares import count_shares

if TYPE_CHECKING:
    from typing_extensions import Self


OTHER_BRANCH = (
    "one branch of that If is made for inputs of other lengths: give those for which all of its branches are made "
    "(--shape), or cut the branch that the robot needs out of the file (onnx.utils.extract_model)"
)
TOLERANCE = 1e-3
"""Largest relative L2 difference between a file and what it was converted to."""
SAMPLES = 32
"""Observations on which a file and what it was converted to are compared."""


class GraphSource(Source):
    """A policy that is one graph; the spec comes from a description, or from the graph's inputs and outputs.

    A source of this kind says where the graph comes from and what it is compared with (``read``).
    """

    holds_code: ClassVar[bool] = False
    """Whether the file may hold code, so that it is opened only where it was trusted by name."""
    where_made: ClassVar[str] = WHERE_MADE
    """What helps against a graph that ONNX Runtime refuses."""
    where_differs: ClassVar[str] = "leave --opset out, or export the file again where it was made"
    """What helps against a graph that computes something else than the file."""
    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    model: Path = Field(description="the file, or the directory, that holds the policy")
    policy: Path | None = Field(
        None, description="policy.yaml with spec and assets; the file's own shapes when not given"
    )
    opset: int | None = Field(None, ge=7, le=23, description="convert the default ONNX domain to this opset")
    shape: tuple[str, ...] = Field((), description="lengths of free axes: NAME=1,3,224,224")
    control_hz: float | None = Field(
        None, gt=0, description="rate of the control loop when there is no policy.yaml, in Hz"
    )

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a file, with the description beside it if there is one."""
        path = Path(typed)
        beside = path.parent / FILE
        return cls(model=path, policy=beside if beside.is_file() else None)

    def describe(self) -> Description | None:
        """Read the ``policy.yaml``, if there is one."""
        if self.policy is None:
            return None
        return self.with_given(replace(read_description(self.policy), graphs={"main": self.model}))

    def as_recorded(self, entry: Mapping[str, Any], bundle: Bundle) -> Self:
        """Convert to the opset of the record and take its shapes, where it has them."""
        options = entry.get("options", {})
        opset, shape = options.get("opset"), options.get("shape")
        update = {"opset": opset} if isinstance(opset, int) else {}
        return self.model_copy(update=update | ({"shape": tuple(shape)} if isinstance(shape, list) else {}))

    def inputs(self) -> tuple[Path, ...]:
        """The policy, external data beside it and what the description names."""
        beside = [self.model] if self.model.is_dir() else sorted(self.model.parent.glob(self.model.name + "*"))
        if (described := self.describe()) is None:
            return (*beside, *(path for purpose in PURPOSES if (path := getattr(self, purpose))))
        return (*beside, *described.recordings().values(), *described.read_from, *described.assets())

    def shapes(self) -> dict[str, tuple[int | str, ...]]:
        """Return input -> axes of ``--shape``."""
        return shapes_from(self.shape)

    def file(self) -> Path:
        """Return the file that ONNX Runtime opens where nothing else is the reference."""
        return self.model

    def write_assets(self, described: Description, out: Path) -> None:
        """Write tokenizers and statistics to ``assets/``."""
        copy_assets(described, out)

    def read(self, description: Description | None, context: Context) -> tuple[Any, Any]:
        """Return the graph as a ``ModelProto`` with its weights, and what runs the policy itself.

        The latter is an object with ``run(feeds)``; None where ONNX Runtime opens the file.

        Raises:
            SourceError: when the file is not what it should be.
        """
        raise NotImplementedError

    def run(self, source: Bundle | None, out: Path, context: Context) -> Result:
        """Read the graph, store it, and run it."""
        description = self.describe()
        if description is not None:
            _check_program(description)
        read, reference = self.read(description, context)
        model = plain(read)
        changes = replace(self._prepare(model, description, context), reference=reference)
        (out / "graphs").mkdir()
        file = out / "graphs/main.onnx"
        if description is None:
            with _named_after(self, file):
                complete_outputs(model, file, _tensors(model.graph.input))
        described = description or self.with_given(self.description_of(model))
        _check_names(model, described.spec)
        refuse_random_file(model, self.model)
        self.write_assets(described, out)
        carry_recordings(described, out)
        manifest = described.manifest()
        options = {"opset": self.opset, "shape": list(self.shape)}
        recorded = self.record({"model": self.model.name, **{name: value for name, value in options.items() if value}})
        with _named_after(self, file):
            opset, stored = self._store(model, out, manifest, changes)
            observations = observations_for(Bundle(out, manifest), 2)
            shares, uncounted = count_shares(file)
            graphs = {"main": Graph("graphs/main.onnx", shares, opset)}
            made = finish(Bundle(out, manifest), out, made_by=recorded, graphs=graphs, observations=observations)
            return Result(made, (*changes.messages, *stored, *uncounted))

    def _prepare(self, model: Any, description: Description | None, context: Context) -> _Changes:
        """Bring types and axes into the form that stages take, in place."""
        refuse_types(model, described=description is not None)
        if description is not None and self.shape:
            raise SourceError(
                f"--shape is given, and {self.policy} says the shapes of all inputs.",
                "leave --shape out, or change them there",
            )
        gone = as_float32(model)
        declared = {tensor.name: tensor.shape for tensor in description.spec.inputs} if description else None
        unbatched = _without_batch(model, declared or {})
        fixed = axes_text(
            fix_axes(model, {**(declared or self.shapes()), **unbatched}, declared is not None, str(self.model))
        )
        further = add_batch_axes(model, opset_of(model)) if unbatched or not description else []
        if further:
            axes = f"{', '.join(further)} of the file have no batch axis: one of 1 is put in front"
            fixed = f"{fixed}; {axes}" if fixed else axes
        if fixed:
            context.progress(fixed, None)
        tolerance = max(TOLERANCE, *(ROUNDING.get(kind, 0) for kind in gone), 0)
        return _Changes(further, tolerance, (describe_conversion(gone),) if gone else ())

    def _store(self, model: Any, out: Path, manifest: Manifest, changes: _Changes) -> tuple[int, tuple[str, ...]]:
        """Write the graph, in the opset that is asked for or that stages need; return its opset, and what was done.

        Raises:
            GraphError: when ONNX Runtime refuses it.
            SourceError: when it cannot be converted, or computes something else than the file.
        """
        opset, file = opset_of(model), out / "graphs/main.onnx"
        wanted = self.opset or max(opset, MIN_OPSET if opset else 0)
        save(model, file)
        before, unbatched = self._before(file, changes)
        stays: tuple[str, ...] = ()
        if wanted != opset:
            try:
                save(with_opset(model, wanted), file)
                self._compare(before, unbatched, out, manifest, changes.tolerance)
                return wanted, (f"converted from opset {opset} to {wanted}; the same on {SAMPLES} observations",)
            except InputError as error:
                if self.opset:
                    raise
                words = f"opset {opset} stays, in which nothing can be quantized to int8 ({MIN_OPSET} or later): "
                stays = (f"{words}{error.message}",)
                save(model, file)
        self._compare(before, unbatched, out, manifest, changes.tolerance)
        return opset, stays

    def _before(self, file: Path, changes: _Changes) -> tuple[Any, list[str]]:
        """Open the file itself, or where ONNX Runtime refuses it what is written of it; and what has no batch axis."""
        if changes.reference is not None:
            return changes.reference, changes.further
        for path, unbatched in ((self.file(), changes.further), (file, [])):
            try:
                with engine_call(engine_class(), f"opened {path.name}"):
                    return engine_class()(path, threads=1), unbatched
            except GraphError:
                if path == file:
                    raise
        raise AssertionError

    def description_of(self, model: Any) -> Description:
        """Describe the policy by its graph, where nobody wrote a description."""
        inputs, outputs = _tensors(model.graph.input), _tensors(model.graph.output)
        if not inputs or not outputs:
            lacks = "takes no inputs" if not inputs else "gives no outputs"
            raise SourceError(f"{self.model} {lacks}; a policy acts on what it sees.", self.where_made)
        rows = math.prod(axis for axis in outputs[0].shape[:-1] if isinstance(axis, int))
        spec = PolicySpec(inputs, outputs, self.control_hz, chunk=rows, execute=1 if rows > 1 else 0)
        return Description(self.model.parent, self.model.stem, "0.0.0", spec)

    def _compare(self, before: Any, unbatched: list[str], out: Path, manifest: Manifest, tolerance: float) -> None:
        """Compare the stored graph with a session of the file, which has no batch axis in some tensors.

        Raises:
            SourceError: when ONNX Runtime computes something else.
        """
        with engine_call(engine_class(), "opened main.onnx"):
            after = engine_class()(out / "graphs/main.onnx", threads=1)
        programs = [Program(manifest.program, {"main": session}, SEED) for session in (before, after)]
        encode = ObservationEncoder(manifest.spec, out / "assets")
        for number, observation in enumerate(observations_for(seal(out, manifest), SAMPLES)):
            feeds = encode(observation)
            as_before = {name: value[0] if name in unbatched else value for name, value in feeds.items()}
            expected, got = (
                program.run(inputs) for program, inputs in zip(programs, (as_before, dict(feeds)), strict=True)
            )
            for tensor in manifest.spec.outputs:
                if not np.isfinite(expected[tensor.name]).all():
                    raise SourceError(
                        f"'{tensor.name}' of {self.model.name} holds NaN or infinity on observation {number}.",
                        "look for weights that are not finite, and for shapes or dtypes for which it was not made",
                    )
                error = relative_error(got[tensor.name], expected[tensor.name])
                if not error <= tolerance:
                    raise SourceError(
                        f"Converted, '{tensor.name}' of {self.model.name} is another one on observation {number}: "
                        f"relative L2 error {error:.3g}, allowed {tolerance:g}.",
                        self.where_differs,
                    )


@dataclass(frozen=True)
class _Changes:
    """What was done to a file.

    Args:
        further: Inputs and outputs that were given a batch axis.
        tolerance: Relative L2 difference that this may make.
        messages: Sentences on it.
        reference: What runs the policy itself; None where the file does.
    """

    further: list[str]
    tolerance: float = TOLERANCE
    messages: tuple[str, ...] = ()
    reference: Any = None


def _check_program(described: Description) -> None:
    """Refuse a program that runs another graph than the one that an ONNX file is."""
    further = next((step.graph for step in described.program if step.graph != "main"), None)
    if further is not None:
        raise SourceError(
            f"The program in {described.read_from[0]} runs the graph '{further}'; a policy that is one ONNX file only "
            "has the graph 'main'.",
            "write graph: main in each step, or leave the program out",
        )


def _without_batch(model: Any, declared: Mapping[str, tuple[int | str, ...]]) -> dict[str, tuple[int | str, ...]]:
    """Return the inputs that a description gives a batch axis of 1 which the file lacks, without it."""
    ranks = {value.name: len(value.type.tensor_type.shape.dim) for value in model.graph.input}
    return {
        name: shape[1:]
        for name, shape in declared.items()
        if shape[:1] == (1,) and len(shape) == ranks.get(name, 0) + 1
    }


def _tensors(values: Iterable[Any]) -> tuple[TensorSpec, ...]:
    return tuple(_tensor(value) for value in values)


def _tensor(value: Any) -> TensorSpec:
    kind = value.type.tensor_type
    axes = [axis.dim_value if axis.HasField("dim_value") else (axis.dim_param or "n") for axis in kind.shape.dim]
    if axes and isinstance(axes[0], str):
        axes[0] = 1
    if math.prod(axis for axis in axes if isinstance(axis, int)) < 1:
        raise SourceError(
            f"'{value.name}' has the shape {axes}; each axis of a policy's tensors has a length of 1 or more.",
            "export the file again where it was made, without what is empty",
        )
    return TensorSpec(value.name, tuple(axes), type_name(kind.elem_type))


def _check_names(model: Any, spec: PolicySpec) -> None:
    for tensors, values in ((spec.inputs, model.graph.input), (spec.outputs, model.graph.output)):
        names = [value.name for value in values]
        for tensor in tensors:
            if tensor.name not in names:
                raise SourceError(
                    f"The ONNX file has no '{tensor.name}', which the spec names; {suggest(tensor.name, names)}.",
                    "name inputs and outputs in policy.yaml as the file does",
                )


@contextlib.contextmanager
def _named_after(source: GraphSource, copy: Path) -> Iterator[None]:
    """Report what is wrong with a copy by the user's own file: the copy is gone by the time they read it."""
    try:
        yield
    except InputError as error:
        error.message = error.message.replace(str(copy), str(source.model))
        if error.fix == REMEDY.format(package=engine_class().package):  # it was not made by vlatool
            error.fix = OTHER_BRANCH if "Op (If)" in error.message else source.where_made
        raise
