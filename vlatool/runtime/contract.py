"""What the graphs give and take, checked against the spec: when a policy is opened, and at every inference."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.manifest import Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import GraphError, SpecError, suggest
from vlatool.files.printable import amount
from vlatool.runtime.observation import all_finite

Array = NDArray[Any]
ON_A_ROBOT = "do not execute it; check the last observation"
"""What helps where an answer is not finite and a robot waits for it."""
OF_THE_POLICY = (
    "correct the policy: by itself it gives NaN or infinity there; look for a division by zero, log or sqrt of what is "
    "not positive, and a softmax over nothing"
)
OF_NOT_FINITE = (
    "its spec says finite: false: let the policy replace such values before it computes with them (torch.nan_to_num, "
    "or torch.where with torch.isfinite), or leave that out of the spec"
)
OF_THE_GRAPHS = (
    "leave layers out with --exclude, or use another method or --opset: what it was made from answers finite values"
)
EXPORT_AGAIN = "declare in the spec what the policy gives, or fix the policy, and export it again"
BASE_MB = 2000.0
TIMES_GRAPHS = 8.0
"""A policy may take ``BASE_MB`` and this many times the size of its graphs: an engine unpacks them."""


class Port(NamedTuple):
    """Shape and dtype of an input or output of a graph, or of a value of a program.

    Args:
        axes: Sizes, None for one that is known when the graph runs; None when even their number is.
        dtype: As numpy calls it; an engine's own name for a type that numpy lacks.
    """

    axes: tuple[int | None, ...] | None
    dtype: str

    def __str__(self) -> str:
        if self.axes is None:
            return self.dtype
        return f"{self.dtype} [{', '.join('?' if axis is None else str(axis) for axis in self.axes)}]"

    def fits(self, other: Port) -> bool:
        """Return whether both can be the same array."""
        if self.dtype != other.dtype:
            return False
        if self.axes is None or other.axes is None:
            return True
        return len(self.axes) == len(other.axes) and all(
            one is None or two is None or one == two for one, two in zip(self.axes, other.axes, strict=True)
        )

    @property
    def bytes(self) -> int:
        """Size in bytes with every unknown axis counted as 1; 0 for a type that numpy lacks."""
        try:
            width = np.dtype(self.dtype).itemsize
        except TypeError:
            return 0
        return width * math.prod(axis or 1 for axis in self.axes or ())


def port(axes: Sequence[Any], dtype: str) -> Port:
    """Return a port; anything but a whole number stands for a free axis."""
    return Port(tuple(axis if isinstance(axis, int) else None for axis in axes), dtype)


def check_chunk(spec: PolicySpec) -> None:
    """Check that ``chunk`` is the number of actions that the shape of the action holds.

    That is the product of all axes but the last: 8 for [1, 8, 7], 1 for [1, 7]. A free axis is believed.

    Raises:
        SpecError: when it is not.
    """
    leading = spec.action.shape[:-1]
    sizes = [axis for axis in leading if isinstance(axis, int)]
    if len(sizes) < len(leading) or math.prod(sizes) == spec.chunk:
        return
    actions, name = math.prod(sizes), spec.action.name
    raise SpecError(
        f"The spec has chunk {spec.chunk}; the shape {list(spec.action.shape)} of the output '{name}' holds "
        f"{amount(actions, 'action')}.",
        f"write chunk: {actions} (and execute: for how many of them are executed), or another shape",
    )


def allowed_mb(manifest: Manifest, memory_mb: float | None) -> float:
    """Return the memory in 10^6 bytes that a policy may take: what the caller says, else by the size of its graphs."""
    if memory_mb is not None:
        return memory_mb
    graphs = sum(manifest.files[graph.file].bytes for graph in manifest.graphs.values() if graph.file in manifest.files)
    return BASE_MB + TIMES_GRAPHS * graphs / 1e6


def check_sizes(manifest: Manifest, limit_mb: float) -> None:
    """Check the sizes in the manifest before anything of that size is allocated.

    Raises:
        GraphError: when inputs, outputs, noise and kept values would be larger than ``limit_mb`` (10^6 bytes).
    """
    spec = manifest.spec
    named = {tensor.name: _declared(tensor) for tensor in (*spec.inputs, *spec.outputs)}
    for step in manifest.program:
        named |= sources_of(step)
    _check_total(named, "The program", limit_mb)


def input_shapes(manifest: Manifest, graph: str) -> dict[str, tuple[int, ...]]:
    """Return input of a graph -> its shape, as spec and program say; nothing where one is free, or given by a graph."""
    known = {tensor.name: _declared(tensor) for tensor in manifest.spec.inputs}
    for step in manifest.program:
        known |= sources_of(step)
    shapes: dict[str, tuple[int, ...]] = {}
    for step in manifest.program:
        for name, value in step.feeds.items() if step.graph == graph else ():
            axes = known[value].axes if value in known else None
            fixed = tuple(axis for axis in axes or () if axis is not None)
            if axes is None or len(fixed) < len(axes) or shapes.setdefault(name, fixed) != fixed:
                return {}
    return shapes


def check_graphs(manifest: Manifest, sessions: Mapping[str, Any], limit_mb: float) -> None:
    """Check what the open graphs declare against the spec, and against each other along the program.

    Args:
        sessions: Graph name -> session; one without ``takes`` and ``gives`` is believed.
        limit_mb: Of what one graph takes and gives together, in 10^6 bytes.

    Raises:
        GraphError: naming graph and tensor, what it is and what is declared.
    """
    for name, session in sessions.items():
        ports = {**getattr(session, "takes", {}), **getattr(session, "gives", {})}
        _check_total(ports, f"The graph '{name}'", limit_mb)
    values: dict[str, tuple[str, Port]] = {
        tensor.name: ("the spec declares", _declared(tensor)) for tensor in manifest.spec.inputs
    }
    for step in manifest.program:
        _follow(step, sessions[step.graph], values)
    for tensor in manifest.spec.outputs:
        origin, actual = values.get(tensor.name, ("", _declared(tensor)))
        if not actual.fits(_declared(tensor)):
            raise GraphError(
                f"The output '{tensor.name}' is declared as {_declared(tensor)} in the spec, but {origin} {actual}.",
                _remedy(actual.dtype, tensor.dtype),
            )


def _follow(step: ProgramStep, session: Any, values: dict[str, tuple[str, Port]]) -> None:
    """Check what a step feeds to its graph, and note what it gives."""
    takes, gives = getattr(session, "takes", None), getattr(session, "gives", None)
    if takes is None or gives is None:
        for name in step.gives.values():
            values.pop(name, None)
        return
    _check_names(step, takes, gives)
    values.update({name: ("the program makes", drawn) for name, drawn in sources_of(step).items()})
    for turn in range(min(step.repeat, 2)):
        for name, value in step.feeds.items():
            _check_feed(step.graph, name, takes[name], value, values, turn)
        for name, value in step.gives.items():
            values[value] = (f"the graph '{step.graph}' gives", gives[name])
        for source, target in step.carry.items():
            values[target] = values[source]


def _check_feed(
    graph: str, name: str, expected: Port, value: str, values: Mapping[str, tuple[str, Port]], turn: int
) -> None:
    origin, actual = values.get(value, ("", expected))
    if not actual.fits(expected):
        when = " in the next repeat" if turn else ""
        raise GraphError(
            f"The graph '{graph}' takes '{name}' as {expected}, but {origin} '{value}' as {actual}{when}.", EXPORT_AGAIN
        )


def _check_names(step: ProgramStep, takes: Mapping[str, Port], gives: Mapping[str, Port]) -> None:
    for words, named, known in (("takes", step.feeds, takes), ("gives", step.gives, gives)):
        for name in named:
            if name not in known:
                raise GraphError(f"The graph '{step.graph}' {words} no '{name}'; {suggest(name, known)}.", EXPORT_AGAIN)
    for name in takes:
        if name not in step.feeds:
            raise GraphError(f"The graph '{step.graph}' takes '{name}', which the program does not feed.", EXPORT_AGAIN)


def sources_of(step: ProgramStep) -> dict[str, Port]:
    """Return what a step creates: noise, kept values and schedules."""
    ports = {name: port(noise["shape"], "float32") for name, noise in step.noise.items()}
    ports |= {name: port(kept["shape"], str(kept.get("dtype", "float32"))) for name, kept in step.keep.items()}
    for name, numbers in step.schedule.items():
        ports[name] = Port((1,), "int64" if all(isinstance(number, int) for number in numbers) else "float32")
    return ports


def _check_total(named: Mapping[str, Port], who: str, limit_mb: float) -> None:
    total = sum(tensor.bytes for tensor in named.values())
    if total > limit_mb * 1e6:
        largest = max(named, key=lambda name: named[name].bytes)
        raise GraphError(
            f"{who} has inputs and outputs of {total / 1e6:,.0f} MB, most of it '{largest}' ({named[largest]}); "
            f"allowed: {limit_mb:,.0f} MB.",
            "declare smaller ones; where they are right, a robot allows more memory: load(..., memory_mb=...)",
        )


def written_as_declared(manifest: Manifest, sessions: Mapping[str, Any]) -> set[str]:
    """Return the outputs that an engine writes into arrays of the declared shape and dtype: it can give nothing else.

    Those are what one graph gives, and nothing else makes, where its session has ``bound`` (``check_graphs`` has
    checked what it gives against the spec).
    """
    makers: dict[str, list[bool]] = {}
    for step in manifest.program:
        bound = getattr(sessions.get(step.graph), "bound", False)
        for name in step.gives.values():
            makers.setdefault(name, []).append(bound)
        for name in (*step.carry.values(), *sources_of(step)):
            makers.setdefault(name, []).append(False)
    return {tensor.name for tensor in manifest.spec.outputs if makers.get(tensor.name) == [True]}


class Outputs:
    """Checks the values of an inference against the outputs that a spec declares: shape, dtype, finite numbers.

    Args:
        action: Whether the first is checked for finite numbers, too; a policy does that in physical units.
        certain: Names of outputs whose shape and dtype need no check.
    """

    def __init__(self, outputs: Iterable[TensorSpec], *, action: bool = True, certain: Collection[str] = ()) -> None:
        self.names = []
        self._checked = []
        for number, tensor in enumerate(outputs):
            dtype = np.dtype(tensor.dtype)
            fixed = tensor.shape if all(isinstance(axis, int) for axis in tensor.shape) else None
            floating = dtype.kind == "f" and (action or number > 0)
            self.names.append(tensor.name)
            if floating or tensor.name not in certain:
                self._checked.append((tensor.name, fixed, dtype, floating, tensor))

    @property
    def certain(self) -> bool:
        """Whether there is nothing to check."""
        return not self._checked

    def __call__(self, values: Mapping[str, Any], who: str = "The policy") -> dict[str, Array]:
        """Return the outputs by name; raises GraphError naming the output, what it is and what is declared."""
        for name, shape, dtype, floating, tensor in self._checked:
            array = values[name]
            if array.dtype != dtype or (array.shape != shape and (shape or not _fits(array, tensor))):
                raise _misfit(array, tensor, who)
            if floating and not all_finite(array):
                raise not_finite(name)
        return {name: values[name] for name in self.names}


def not_finite(name: str, what: str = "output") -> GraphError:
    """Return the error of an output or a kept value that holds NaN or infinity."""
    return GraphError(f"The {what} '{name}' is not finite.", ON_A_ROBOT)


@contextlib.contextmanager
def off_the_robot(where: str, fix: str) -> Iterator[None]:
    """Give an answer that is not finite a place and the remedy of who makes or measures a bundle: nobody executes it.

    Args:
        where: Which observation it answers, the end of a sentence: ``observation 3``.
    """
    try:
        yield
    except GraphError as error:
        if error.fix.startswith(ON_A_ROBOT):
            error.message, error.fix = f"{error.message.rstrip('.')} (the answer to {where}).", fix
        raise


def _fits(array: Array, tensor: TensorSpec) -> bool:
    return array.size > 0 and Port(array.shape, tensor.dtype).fits(_declared(tensor))


def _misfit(array: Array, tensor: TensorSpec, who: str) -> GraphError:
    got = Port(tuple(array.shape), str(array.dtype))
    return GraphError(
        f"{who} gives '{tensor.name}' as {got}; the spec declares {_declared(tensor)}.",
        _remedy(got.dtype, tensor.dtype),
    )


def _remedy(got: str, declared: str) -> str:
    if got == declared:
        return EXPORT_AGAIN
    return f"cast it to {declared} in forward(), or declare another dtype in the spec, and export the policy again"


def _declared(tensor: TensorSpec) -> Port:
    return port(tensor.shape, tensor.dtype)
