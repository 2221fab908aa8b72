"""The own steps of a module's ``forward()``, recorded in one run as a program that calls its parts.

What torch's dynamo exporter refuses is often Python between the parts of a policy: a check of an input, a number read
from a tensor. A recording holds the operators of one run and calls the parts as they are, so that dynamo translates
them as usual. What depended on values stays as it was in that run, which the caller must prove to be harmless
(``decisions.py``, and a comparison on other inputs).
"""

from __future__ import annotations

import contextlib
import operator
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vlatool.errors import GraphError, require

if TYPE_CHECKING:
    from torch import nn

Call = Callable[[Any, Callable[[], Any], Any, Any], Any]
"""Module, what calls it, positional arguments, named arguments -> its result."""


def record_forward(module: nn.Module, arguments: Sequence[Any], graph: str) -> Any:
    """Run a module once and return what it did as a ``torch.fx.GraphModule`` that calls the same parts.

    The parts are what the outermost ``forward()`` calls that calls more than one module.

    Args:
        arguments: a tensor for each input.
        graph: name of the graph, for errors.

    Raises:
        GraphError: when the module has no parts.
    """
    fx = require("torch.fx", "build")
    parts = _parts(module, arguments)
    if not parts:
        raise GraphError(f"The module of '{graph}' calls no two modules in turn.", "export it with another exporter")
    recorder = _recorder(module, parts)
    given = [tensor.clone() for tensor in arguments]
    for number, tensor in enumerate(given):
        recorder.define(tensor, recorder.graph.placeholder(f"argument_{number}"))
    with _module_calls(recorder.call), recorder:
        result = module(*given)
    outputs = result if isinstance(result, tuple | list) else [result]
    recorder.graph.output(tuple(recorder.as_nodes(value) for value in outputs))
    return fx.GraphModule(recorder.attributes, recorder.graph).eval()


def _parts(module: nn.Module, arguments: Sequence[Any]) -> dict[int, str]:
    """Return id -> path of the modules that the outermost forward() with more than one call calls; empty for none."""
    names = {id(part): path for path, part in module.named_modules()}
    stack, called = [id(module)], dict[int, Counter[int]]()

    def call(part: Any, run: Callable[[], Any], _args: Any, _kwargs: Any) -> Any:
        if part is module or id(part) not in names:
            return run()
        called.setdefault(stack[-1], Counter())[id(part)] += 1
        stack.append(id(part))
        try:
            return run()
        finally:
            stack.pop()

    with _module_calls(call):
        module(*(tensor.clone() for tensor in arguments))
    at = id(module)
    while called.get(at, Counter()).total() == 1:
        (at,) = called[at]
    return {part: names[part] for part in called.get(at, ())}


@contextlib.contextmanager
def _module_calls(around: Call) -> Iterator[None]:
    """Let a function see every call of a module in this block, and make it."""
    kind = require("torch", "build").nn.Module
    original = kind.__call__

    def call(module: Any, *args: Any, **kwargs: Any) -> Any:
        return around(module, lambda: original(module, *args, **kwargs), args, kwargs)

    kind.__call__ = call
    try:
        yield
    finally:
        kind.__call__ = original


def _recorder(module: nn.Module, parts: Mapping[int, str]) -> Any:
    """Return a mode of torch that writes every function of tensors outside the parts into a graph."""
    torch, fx = require("torch", "build"), require("torch.fx", "build")
    held = [*module.named_parameters(remove_duplicate=False), *module.named_buffers(remove_duplicate=False)]
    stored = {id(tensor): path for path, tensor in held}

    class Recorder(require("torch.overrides", "build").TorchFunctionMode):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.graph = fx.Graph()
            self.attributes: dict[str, Any] = {}
            self._nodes: dict[int, tuple[Any, Any]] = {}  # the tensor too: an id is of a living object
            self._inside = False

        def define(self, value: Any, node: Any) -> None:
            """Note which node gives a tensor, or the tensors that an object holds."""
            if isinstance(value, torch.Tensor):
                self._nodes[id(value)] = value, node
            for key, item in _items(value):
                get = getattr if isinstance(key, str) and not isinstance(value, Mapping) else operator.getitem
                if _holds_tensor(torch, item):
                    self.define(item, self.graph.call_function(get, (node, key)))

        def as_nodes(self, value: Any) -> Any:
            """Return a value with nodes in the place of its tensors."""
            return torch.utils._pytree.tree_map_only(torch.Tensor, self._node, value)

        def call(self, part: Any, run: Callable[[], Any], args: Any, kwargs: Any) -> Any:
            """Record the call of a part; other modules are what their functions are."""
            if self._inside or id(part) not in parts:
                return run()
            self.attributes[parts[id(part)]] = part
            node = self.graph.call_module(parts[id(part)], self.as_nodes(args), self.as_nodes(kwargs))
            self._inside = True
            try:
                result = run()
            finally:
                self._inside = False
            self.define(result, node)
            return result

        def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            result = func(*args, **(kwargs or {}))
            if self._inside:
                return result
            if getattr(func, "__name__", "") == "__setitem__":
                self.graph.call_function(operator.setitem, self.as_nodes(args))
            elif _holds_tensor(torch, result):
                self.define(result, self._called(func, self.as_nodes(args), self.as_nodes(dict(kwargs or {}))))
            return result

        def _node(self, tensor: Any) -> Any:
            if id(tensor) not in self._nodes:
                path = stored.get(id(tensor), f"recorded_constant_{len(self.attributes)}")
                self.attributes[path] = tensor
                self._nodes[id(tensor)] = tensor, self.graph.get_attr(path)
            return self._nodes[id(tensor)][1]

        def _called(self, func: Any, args: Any, kwargs: Any) -> Any:
            name = getattr(func, "__name__", "")
            if name == "__get__":
                return self.graph.call_function(getattr, (args[0], func.__self__.__name__))
            if getattr(torch.Tensor, name, None) is func:
                return self.graph.call_method(name, args, kwargs)
            return self.graph.call_function(func, args, kwargs)

    return Recorder()


def _items(value: Any) -> list[tuple[Any, Any]]:
    """Return key or index -> what a result of a module holds."""
    if isinstance(value, Mapping):
        return list(value.items())
    if isinstance(value, tuple | list):
        return list(enumerate(value))
    return list(vars(value).items()) if hasattr(value, "__dict__") and not hasattr(value, "dtype") else []


def _holds_tensor(torch: Any, value: Any) -> bool:
    return any(isinstance(leaf, torch.Tensor) for leaf in torch.utils._pytree.tree_leaves(value))
