"""A graph that is believed only where ONNX Runtime gives with it what torch gives; else another exporter is tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.program import ProgramStep
from vlatool.errors import GraphError, VlatoolError, require
from vlatool.files.printable import amount, message_of, one_line
from vlatool.files.scratch import scratch_directory
from vlatool.graph.float32_conversion import ROUNDING, rewrite_as_float32
from vlatool.graph.random_ops import refuse_random_ops
from vlatool.machine.engine_calls import engine_call
from vlatool.module.batched_program import run_module
from vlatool.module.changed_buffers import refuse_changed_buffers
from vlatool.module.decisions import decisions_of
from vlatool.module.divergence import first_divergence
from vlatool.module.exporters import EXPORTERS
from vlatool.module.folding import fold_weights
from vlatool.module.to_onnx import (
    EXTERNAL_DATA_BYTES,
    name_by_module,
    rewrite_for_engines,
    strip_notes,
    weight_bytes,
)
from vlatool.module.torch_policy import TorchSession
from vlatool.runtime.engine import engine_class
from vlatool.runtime.policy import relative_error

if TYPE_CHECKING:
    from torch import nn

Call = tuple[Mapping[str, Any], Mapping[str, Any]]
"""What a module is given, and what torch gives with it: arrays by name."""
MAX_CALLS = 12
"""Calls of a module on which its graph is compared with it."""
MAX_BYTES = 1 << 29
"""Bytes of these calls; two are always kept."""
LEAST_DIFFERENCE = 2.0**-22
"""Largest difference of an element of outputs that count as the same: two roundings of a float32 near 1."""
NUDGE = 1e-6
"""Relative change of an input after which a function that does not jump gives the same."""
REASON_CHARACTERS = 400
WHERE_DIFFERENT = (
    "look for state that forward() keeps in its modules (declare it with 'keep' in the program), or raise --tolerance "
    "if you know why"
)


@dataclass(frozen=True)
class Exported:
    """A graph that gives what torch gives.

    Args:
        model: an ``onnx_ir.Model``, its nodes named by module.
        exporter: name of the exporter that made it.
        failures: exporters that were tried before -> why they were not taken.
        readers: places where ``forward()`` read values out of tensors, the same for all inputs; where no exporter
            translated that.
    """

    model: Any
    exporter: str
    failures: Mapping[str, GraphError]
    readers: tuple[str, ...] = ()

    def notes(self, graph: str, calls: int) -> tuple[str, ...]:
        """Return what there is to say of the choice."""
        tried = "".join(f"; {name} not, because: {_reason(error)}" for name, error in self.failures.items())
        said = (f"{graph}: exported by {self.exporter}{tried}",) if tried or self.exporter != "dynamo" else ()
        if not self.readers:
            return said
        return (*said, f"{graph}: forward() decides by values at {', '.join(self.readers)}; the graph holds what it "
                f"did for each of {amount(calls, 'input')}, and would not do anything else")  # fmt: skip


class CalledSession(TorchSession):
    """A torch module behind the session interface that remembers a few of its calls, drawn evenly of all."""

    def __init__(self, module: nn.Module, step: ProgramStep) -> None:
        super().__init__(module, step)
        self.calls: list[Call] = []
        self._count, self._random = 0, np.random.default_rng(0)

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the module, and remember the call, unless it gives something that is not a number."""
        outputs = super().run(feeds)
        if not any(np.isnan(value).any() for value in outputs.values()):
            self._remember(_copies(feeds), _copies(outputs))
        return outputs

    def _remember(self, feeds: Mapping[str, Any], outputs: Mapping[str, Any]) -> None:
        size = sum(np.asarray(value).nbytes for value in (*feeds.values(), *outputs.values()))
        limit = min(MAX_CALLS, max(2, MAX_BYTES // max(size, 1)))
        index = self._count if self._count < limit else int(self._random.integers(1, self._count + 1))
        if index < limit:
            self.calls[index : index + 1] = [(feeds, outputs)]
        self._count += 1


def _copies(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return arrays that neither the module nor an exporter changes in place."""
    return {name: np.array(value) for name, value in values.items()}


def proven_export(
    session: CalledSession, arguments: Sequence[Any], opset: int, tolerance: float, exporters: Sequence[str]
) -> Exported:
    """Export a module with the first exporter whose graph loads, runs, and gives what torch gives.

    Weights beyond 1.5 GB are not opened twice: such a graph is compared with the whole policy alone, by the caller.

    Args:
        session: the module, and calls of it to compare on.
        arguments: a tensor for each feed.
        exporters: names of ``EXPORTERS``, in the order in which they are tried.

    Raises:
        GraphError: when no exporter makes such a graph, with the reason of each, or it would draw random numbers.
        SourceError: when an output depends on a buffer that the module changes.
    """
    step, failures = session.step, dict[str, GraphError]()
    for name in exporters:
        try:
            model, program = EXPORTERS[name](session.module, [each.clone() for each in arguments], step, opset)
        except GraphError as error:
            failures[name] = error
            continue
        if program is not None:
            refuse_changed_buffers(program, step.graph)
        refuse_random_ops(model, step.graph)
        _finish(model)
        exported = Exported(model, name, dict(failures))
        if weight_bytes(session.module) > EXTERNAL_DATA_BYTES:
            return exported
        try:
            _compare(model, session, tolerance)
            return replace(exported, readers=() if name == "dynamo" else _readers(session))
        except GraphError as error:
            failures[name] = error
    raise _none_left(failures)


def _finish(model: Any) -> None:
    rewrite_for_engines(model)
    fold_weights(model)
    name_by_module(model)
    strip_notes(model)


def _none_left(failures: Mapping[str, GraphError]) -> GraphError:
    """Return the error that lists every reason; the first exporter's comes first."""
    (_, first), *others = failures.items()
    rest = "".join(f" {name}: {_reason(error)}." for name, error in others)
    return GraphError(f"{first.message}{' The other exporters fail, too.' if rest else ''}{rest}", first.fix)


def _reason(error: GraphError) -> str:
    return one_line(error.message, REASON_CHARACTERS).rstrip(".")


def _compare(model: Any, session: CalledSession, tolerance: float) -> None:
    """Open a graph and run it on what the module was given.

    Raises:
        GraphError: when it does not load, does not run, or gives something else.
    """
    with scratch_directory() as folder:
        file = folder / "graph.onnx"
        require("onnx_ir", "build").save(model, str(file))
        allowed = max([tolerance, *(ROUNDING.get(kind, 0) for kind in rewrite_as_float32(file))])
        for (feeds, expected), given in zip(session.calls, _outputs(file, session), strict=True):
            for name in session.step.gives:
                error = difference(given[name], expected[name])
                if not error <= allowed and not _jumps(session, feeds, expected, name, allowed):
                    node = first_divergence(session.module, file, feeds, allowed)
                    raise _differs(session.step.graph, name, error, allowed, node)


def _outputs(file: Path, session: CalledSession) -> list[Mapping[str, Any]]:
    """Return what ONNX Runtime gives for each call."""
    graph = session.step.graph
    try:
        with engine_call(engine_class(), f"opened the graph '{graph}'"):
            opened = engine_class()(file, threads=1)
        with engine_call(engine_class(), f"ran the graph '{graph}'"):
            return [opened.run(feeds) for feeds, _ in session.calls]
    except Exception as error:  # the seam: an engine raises many foreign types
        text = error.message if isinstance(error, VlatoolError) else message_of(error)
        reason = one_line(text.replace(str(file), file.name), REASON_CHARACTERS).rstrip(".")
        raise GraphError(f"ONNX Runtime does not run the graph '{graph}': {reason}.", WHERE_DIFFERENT) from error


def _differs(graph: str, output: str, error: float, allowed: float, node: str) -> GraphError:
    where = f"; they differ from the node '{node}' of the graph '{graph}' on" if node else ""
    return GraphError(
        f"ONNX Runtime and torch differ on the output '{output}' of the graph '{graph}': relative L2 error "
        f"{error:.3g}, allowed {allowed:g}{where}.",
        WHERE_DIFFERENT,
    )


def difference(got: Any, expected: Any) -> float:
    """Return the relative L2 difference of two outputs; infinite for other shapes, or infinities in other places."""
    got, expected = np.asarray(got), np.asarray(expected)
    finite = np.isfinite(expected)
    if got.shape != expected.shape or not np.array_equal(got[~finite], expected[~finite]):
        return float("inf")
    one, other = got[finite].astype(np.float64), expected[finite].astype(np.float64)
    return 0.0 if np.max(np.abs(one - other), initial=0.0) <= LEAST_DIFFERENCE else relative_error(one, other)


def _jumps(session: CalledSession, feeds: Mapping[str, Any], expected: Any, name: str, allowed: float) -> bool:
    """Return whether torch itself gives something else beside an input: the choice between two equal values.

    Raises:
        GraphError: when it gives something else with the same input.
    """
    run = TorchSession(session.module, session.step).run
    if not difference(run(feeds)[name], expected[name]) <= allowed:
        raise GraphError(
            f"forward() of '{session.step.graph}' gives something else each time that it gets the same input.",
            "let it take random numbers as an input, and declare that as noise in the program; switch dropout off",
        )
    random = np.random.default_rng(0)
    near = {
        key: (value * (1 + NUDGE * random.standard_normal(value.shape))).astype(value.dtype)
        if value.dtype.kind == "f"
        else value
        for key, value in feeds.items()
    }
    return not difference(run(near)[name], expected[name]) <= allowed


def _readers(session: CalledSession) -> tuple[str, ...]:
    """Return where forward() reads values.

    Raises:
        GraphError: where it read other ones for other inputs, so that the graph holds one case of several.
    """
    torch, step = require("torch", "build"), session.step
    given = [[torch.from_numpy(np.array(feeds[name])) for name in step.feeds] for feeds, _ in session.calls]
    with torch.inference_mode():
        found = [decisions_of(partial(run_module, session.module, step, arguments)) for arguments in given]
    for other in found[1:]:
        if where := found[0].difference(other):
            raise GraphError(
                f"forward() of '{step.graph}' decides by its input at {where}; a recording would always do one "
                "of them.",
                "decide with torch.where() instead of 'if', a fixed number of turns instead of 'while'",
            )
    return tuple(dict.fromkeys(line for each in found for line in each.readers))
