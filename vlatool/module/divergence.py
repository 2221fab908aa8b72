"""Where a graph begins to differ from the torch module that it was exported from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.errors import require
from vlatool.files.scratch import scratch_directory
from vlatool.graph.files import read, save
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.engine import engine_class
from vlatool.runtime.policy import relative_error

if TYPE_CHECKING:
    from torch import nn

Values = dict[str, Any]


def first_divergence(
    module: nn.Module, file: Path, feeds: Mapping[str, Any], tolerance: float, before: Sequence[Path] = ()
) -> str:
    """Return the node of a graph from which on it differs from a module, as ``module.path/Operator``; empty for none.

    The output of each submodule is looked for among the values that nodes of that module give in the graph. A submodule
    whose output is not there, while that of the next one is, was folded into it by the exporter, and is passed over.

    Args:
        module: in evaluation mode; takes the feeds in their order.
        file: the graph, whose nodes are named by their modules.
        feeds: input of the module -> numpy array.
        tolerance: relative L2 difference up to which values are the same.
        before: graphs of the same module that run first, and give inputs of the graph by name.
    """
    expected = _module_outputs(module, list(feeds.values()))
    given: dict[str, tuple[str, Any]] = {}
    for part in (*before, file):
        given |= _node_outputs(part, {**feeds, **{name: value for name, (_, value) in given.items()}})
    known = {path: _candidates(path, given) for path in expected}
    same = {path: any(relative_error(value, expected[path]) <= tolerance for _, value in known[path]) for path in known}
    paths = list(expected)
    for path, following in zip(paths, [*paths[1:], ""], strict=True):
        folded = bool(following) and (same[following] or not known[following])
        if known[path] and not same[path] and not folded:
            return min(known[path], key=lambda pair: relative_error(pair[1], expected[path]))[0]
    return ""


def _module_outputs(module: nn.Module, feeds: Sequence[Any]) -> Values:
    """Return path -> what a submodule gave first, in the order in which they ended; lists give their first tensor."""
    torch = require("torch", "build")
    found: Values = {}
    with torch.no_grad(), _recorded(module, found):
        module(*(torch.from_numpy(np.array(feed)) for feed in feeds))
    return found


@contextmanager
def _recorded(module: nn.Module, found: Values) -> Iterator[None]:
    torch = require("torch", "build")

    def hook(path: str) -> Any:
        def store(_module: Any, _inputs: Any, output: Any) -> None:
            first = output[0] if isinstance(output, tuple | list) and output else output
            if isinstance(first, torch.Tensor) and first.is_floating_point() and path not in found:
                found[path] = first.detach().float().numpy().copy()

        return store

    handles = [inner.register_forward_hook(hook(path)) for path, inner in module.named_modules() if path]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _node_outputs(file: Path, feeds: Mapping[str, Any]) -> dict[str, tuple[str, Any]]:
    """Return value -> the node that gives it and what it gives, of all floats of a graph."""
    onnx = require("onnx", "build")
    model = read(file)
    known = {value.name for value in model.graph.output}
    nodes = {name: node.name for node in model.graph.node for name in node.output if name}
    model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in nodes if name not in known)
    with scratch_directory() as folder:
        save(model, folder / "all.onnx")
        taken = {value.name: feeds[value.name] for value in model.graph.input}
        with engine_call(engine_class(), f"ran {file.name} with every value as an output"):
            values = engine_class()(folder / "all.onnx", threads=1).run(taken)
    return {name: (node, values[name]) for name, node in nodes.items() if np.asarray(values[name]).dtype.kind == "f"}


def _candidates(path: str, given: Mapping[str, tuple[str, Any]]) -> list[tuple[str, Any]]:
    """Return the nodes of a module and of what is in it, in their order, and what they give."""
    return [pair for pair in given.values() if pair[0].startswith((f"{path}/", f"{path}."))]
