"""A policy in one file that torch wrote: opened in a child process where it is trusted, exported, and compared."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import DTYPES
from vlatool.errors import SourceError, require, require_present, suggest
from vlatool.files.printable import message_of, one_line
from vlatool.graph.nodes import rename_reads, unique_name
from vlatool.module.description import Description
from vlatool.module.to_onnx import IMPORTS
from vlatool.sources._graph_source import GraphSource
from vlatool.sources._onnx_axes import shapes_from
from vlatool.sources._torch_archive import Kind, kind_of, pickle_error
from vlatool.stage.base import Context
from vlatool.user_code import trust

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

BUILD_IT = "export the Python module that was saved: torch.export.save writes a .pt2, torch.onnx.export a .onnx"
DYNAMIC_LENGTH = 3
"""Length of a free axis in the example that a module is exported with."""


@dataclass(frozen=True)
class OpenedModule:
    """A module of a file.

    Args:
        module: what torch opened.
        run: takes the module and one tensor for each input, and returns a tensor, or any nesting of them.
        inputs: name -> example, in the order of ``run``.
        free: input -> axes whose length is free.
        program: the program of torch.export that the module was made of; None of TorchScript.
    """

    module: Any
    run: Callable[..., Any]
    inputs: Mapping[str, Any]
    free: Mapping[str, Mapping[int, str]]
    program: Any = None

    def __call__(self, *tensors: Any) -> Any:
        """Run the module."""
        return self.run(self.module, *tensors)


class TorchFile(GraphSource):
    """A policy in a file that torch wrote; it is opened in a child process, and only where ``--trust`` allowed it."""

    packages: ClassVar[tuple[str, ...]] = ("torch", "onnx", "onnxscript", "onnxruntime", "numpy")
    imports: ClassVar[tuple[str, ...]] = IMPORTS
    holds_code: ClassVar[bool] = True
    where_made: ClassVar[str] = BUILD_IT
    where_differs: ClassVar[str] = (
        "look for what forward() keeps from call to call: let it take and return that, and keep it in the program of a "
        f"policy.yaml; else {BUILD_IT}"
    )
    holds: ClassVar[Kind]
    """What the file must be."""

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The file is what it should be, as its bytes say; it is trusted; and torch is installed."""
        found = kind_of(self.model)
        if found is Kind.PICKLE:
            raise pickle_error(self.model)
        if found is not self.holds:
            remedy = "save the program with torch.export.save" if found is Kind.COMPILED else "name it FILE" + (
                ".pt2" if found is Kind.PROGRAM else ".pt"
            )  # fmt: skip
            raise SourceError(f"{self.model} is {found.value}, and not {self.holds.value}.", remedy)
        for module in ("torch", "onnxscript", "onnx"):
            require_present(module, "build")
        trust.require_file(self.model)

    def read(self, description: Description | None, context: Context) -> tuple[Any, Any]:
        """Open the file, export what is in it, and return the graph and what runs the module."""
        trust.require_file(self.model)
        torch = require("torch", "build")
        context.progress(f"opening {self.model.name} in torch", None)
        opened = self.open_module(self._declared(description))
        with torch.no_grad():
            outputs = named_leaves(self._run(opened))
        wanted = [tensor.name for tensor in description.spec.outputs] if description else []
        context.progress(f"exporting {self.model.name}", None)
        model = self.export_module(opened, list(outputs))
        return model, Session(opened, _names(list(outputs), wanted))

    def open_module(self, declared: Mapping[str, tuple[tuple[int | str, ...], str]]) -> OpenedModule:
        """Open the file in torch.

        Args:
            declared: Input -> shape and dtype, as a description or ``--shape`` says them.
        """
        raise NotImplementedError

    def export_module(self, opened: OpenedModule, outputs: Sequence[str]) -> Any:
        """Return the module as a ``ModelProto``, its inputs and outputs named."""
        raise NotImplementedError

    def shapes(self) -> dict[str, tuple[int | str, ...]]:
        """Return input -> axes of ``--shape``, which may say dtypes, too."""
        return {name: axes for name, (axes, _) in declared_from(self.shape).items()}

    def _declared(self, description: Description | None) -> dict[str, tuple[tuple[int | str, ...], str]]:
        if description is None:
            return declared_from(self.shape)
        return {tensor.name: (tensor.shape, tensor.dtype) for tensor in description.spec.inputs}

    def _run(self, opened: OpenedModule) -> Any:
        try:
            return opened(*opened.inputs.values())
        except Exception as error:  # the seam: the code of a file may raise anything
            given = ", ".join(f"{name} {_described(tensor)}" for name, tensor in opened.inputs.items())
            raise SourceError(
                f"{self.model} cannot run on {given}: {_last_line(error)}.",
                "correct the shapes or dtypes: --shape NAME=1,16 or NAME=1,16:int64, or the spec of a policy.yaml",
            ) from error


@dataclass(frozen=True)
class Session:
    """An opened module behind the interface of a session.

    Args:
        outputs: leaf of what it returns -> name of the output.
    """

    opened: OpenedModule
    outputs: Mapping[str, str]

    def run(self, feeds: Mapping[str, Any]) -> dict[str, Any]:
        """Run the module on numpy arrays.

        Raises:
            SourceError: with what it raised.
        """
        torch = require("torch", "build")
        tensors = [torch.from_numpy(np.array(feeds[name])) for name in self.opened.inputs]
        try:
            with torch.no_grad():
                leaves = named_leaves(self.opened(*tensors))
        except SourceError:
            raise
        except Exception as error:  # the seam: the code of a file may raise anything
            raise SourceError(
                f"The module fails on an observation that fits its inputs: {_last_line(error)}.",
                "name shapes for which it was made: --shape, or the spec of a policy.yaml",
            ) from error
        return {name: _array(leaves[leaf]) for leaf, name in self.outputs.items()}


def declared_from(texts: Sequence[str]) -> dict[str, tuple[tuple[int | str, ...], str]]:
    """Return input -> shape and dtype of ``NAME=1,16`` and ``NAME=1,16:int64``.

    Raises:
        SourceError: for anything else.
    """
    declared = {}
    for text in texts:
        shape, colon, dtype = text.rpartition(":") if "=" in text.rpartition(":")[0] else (text, "", "")
        if colon and dtype not in DTYPES:
            raise SourceError(f"--shape {text!r} has the dtype '{dtype}'; {suggest(dtype, DTYPES)}.", "correct it")
        [(name, axes)] = shapes_from([shape]).items()
        declared[name] = (axes, dtype or "float32")
    return declared


def example(shape: Sequence[int | str], dtype: str) -> Any:
    """Return a tensor of an input: small random numbers, or ones where they are whole."""
    torch = require("torch", "build")
    lengths = [axis if isinstance(axis, int) else DYNAMIC_LENGTH for axis in shape]
    kind = getattr(torch, dtype)
    if not kind.is_floating_point:
        return torch.ones(lengths, dtype=kind)
    return torch.rand(lengths, generator=torch.Generator().manual_seed(0)).to(kind)


def free_axes(shape: Sequence[int | str]) -> dict[int, str]:
    """Return the axes of a shape that have names."""
    return {index: axis for index, axis in enumerate(shape) if isinstance(axis, str)}


def named_leaves(value: Any) -> dict[str, Any]:
    """Return name -> tensor of what a module returns, however it is nested.

    A leaf has the shortest end of its path that is its own; the first one without a name is the ``action``.

    Raises:
        SourceError: for something else than tensors.
    """
    torch = require("torch", "build")
    paths, _ = torch.utils._pytree.tree_flatten_with_path(value)
    for _, leaf in paths:
        if not isinstance(leaf, torch.Tensor):
            raise SourceError(
                f"The module returns a value of type {type(leaf).__name__}; allowed: tensors, in any nesting.",
                "let forward() return tensors alone, and save it again",
            )
    if not paths:
        raise SourceError("The module returns nothing.", "let forward() return the action")
    return dict(zip(path_names([path for path, _ in paths]), [leaf for _, leaf in paths], strict=True))


def path_names(paths: Sequence[Sequence[Any]]) -> list[str]:
    """Return a name for each path of torch's pytrees: its shortest end that begins with a word and is its own."""
    words = [
        [str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key)))) for key in path] for path in paths
    ]
    names = []
    for number, word in enumerate(words):
        ends = [".".join(word[-count:]) for count in range(1, len(word) + 1)]
        own = [end for end in ends if not end[0].isdigit() and sum(_ends(other, end) for other in words) == 1]
        names.append(own[0] if own else ("action" if number == 0 else f"output_{number}"))
    return names


def _word(key: Any) -> str:
    """Return a key of a dict, a field of a named tuple, or a place in a list."""
    return str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key))))


def _ends(words: Sequence[str], end: str) -> bool:
    whole = ".".join(words)
    return whole == end or whole.endswith(f".{end}")


def rename_ends(model: Any, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Name inputs and outputs of a ``ModelProto`` in place, in their order; another value of such a name gets another.

    An output is given by an Identity: it may be an input, a weight, or another output as well.
    """
    graph, make = model.graph, require("onnx.helper", "build").make_node
    taken = {name for node in graph.node for name in (*node.input, *node.output)} | {*inputs, *outputs}
    taken |= {value.name for value in (*graph.input, *graph.initializer)}
    given = [unique_name(f"{value.name}_given", 0, taken) for value in graph.output]
    for value, name in zip(graph.output, given, strict=True):
        graph.node.append(make("Identity", [value.name], [name], f"{name}/Identity"))
        value.name = name
    for value in graph.input:
        _rename(graph, value.name, inner := unique_name(f"{value.name}_taken", 0, taken))
        value.name = inner
    for name in (*inputs, *outputs):
        _rename(graph, name, unique_name(f"{name}_inside", 0, taken))
    for value, name in zip((*graph.input, *graph.output), (*inputs, *outputs), strict=True):
        _rename(graph, value.name, name)
        value.name = name


def _rename(graph: Any, old: str, new: str) -> None:
    """Rename a value wherever it is made, stored and read."""
    rename_reads(graph, old, new)
    for node in graph.node:
        node.output[:] = [new if name == old else name for name in node.output]
    for tensor in graph.initializer:
        tensor.name = new if tensor.name == old else tensor.name
    for value in graph.value_info:
        value.name = new if value.name == old else value.name


def _names(leaves: Sequence[str], wanted: Sequence[str]) -> dict[str, str]:
    return {leaf: leaf for leaf in leaves if not wanted or leaf in wanted}


def _described(tensor: Any) -> str:
    return f"{list(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"


def _array(tensor: Any) -> Any:
    torch = require("torch", "build")
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).detach().numpy()


def _last_line(error: BaseException) -> str:
    """Return the last line of a message: TorchScript puts its own trace of the code before it."""
    lines = [line.strip() for line in message_of(error).splitlines() if re.search(r"\w", line)]
    return one_line((lines[-1] if lines else type(error).__name__).rstrip("."), 300)


def is_file_of(path: Path, suffixes: Sequence[str]) -> bool:
    """Return whether a path has one of these endings and is not a directory."""
    return path.suffix in suffixes and not path.is_dir()
