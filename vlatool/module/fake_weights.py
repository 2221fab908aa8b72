"""Run a policy's program on fake weights, without their memory, to see what its graphs do at any size."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.data import observations_for
from vlatool.errors import require
from vlatool.module.edits import apply_bundle, loses_units, read_edits
from vlatool.module.factory import map_user_exceptions
from vlatool.module.modules import modules_of, outputs_of
from vlatool.module.origin import origin_of
from vlatool.runtime.contract import sources_of
from vlatool.runtime.observation import ObservationEncoder

DRAWING = (
    "uniform_", "normal_", "trunc_normal_", "xavier_uniform_", "xavier_normal_", "kaiming_uniform_", "kaiming_normal_",
    "orthogonal_", "sparse_",
)  # fmt: skip
"""Functions of ``torch.nn.init`` that draw."""
Visit = Callable[[ProgramStep, Any, list[Any], dict[str, Any]], contextlib.AbstractContextManager[Any] | None]
"""Step, its module, its inputs as fake tensors, real buffers by name -> what the module runs within, if anything."""


@dataclass(frozen=True)
class MetaModules:
    """A policy's modules with every parameter on torch's meta device, changed by the edits of its bundle.

    Args:
        made: graph name -> each parameter and buffer with the name that it had in what the factory made, one that is
            shared with each of its names; empty where a module must be traced.
    """

    modules: dict[str, Any]
    made: dict[str, list[tuple[str, Any]]]


def meta_float32_modules(bundle: Bundle) -> dict[str, Any]:
    """Call the factory of a source bundle, every parameter on torch's meta device: graph name -> float32 module.

    Raises:
        SourceError: when code has changed, the factory fails, or a graph has no module.
    """
    return as_float32(make_meta_modules(bundle).modules)


def as_float32(modules: Mapping[str, Any]) -> dict[str, Any]:
    """Return modules in float32, in which graphs are exported; changed in place."""
    return {name: module.float() for name, module in modules.items()}


def make_meta_modules(bundle: Bundle) -> MetaModules:
    """Call the factory of a source bundle so that no parameter takes memory, and change its structure as it says.

    Raises:
        SourceError: when code has changed, the factory fails, or a graph has no module.
    """
    torch = require("torch", "build")
    origin = origin_of(bundle)
    origin.check((".py",))
    traced = loses_units(read_edits(bundle))  # a trace runs the module, with all that it computes
    with contextlib.nullcontext() if traced else _parameters_on_meta(torch):
        product = origin.build()
    modules = modules_of(product, (step.graph for step in bundle.manifest.program))
    kept = {} if traced else modules
    made = {graph: list(module.state_dict(keep_vars=True).items()) for graph, module in kept.items()}
    modules = apply_bundle(modules, bundle, weights=False)
    for module in modules.values() if traced else ():
        _to_meta(torch, module)
    return MetaModules(modules, made)


def run_on_fake_tensors(bundle: Bundle, modules: Mapping[str, Any], visit: Visit) -> None:
    """Run the program once with fake tensors; ``visit`` is called before each step's module, under the fake mode.

    Raises:
        SourceError: when a module gives another number of outputs than the program takes.
    """
    torch = require("torch", "build")
    encode = ObservationEncoder(bundle.manifest.spec, bundle.path / "assets")
    values = {name: (np.shape(array), array.dtype) for name, array in encode(observations_for(bundle, 1)[0]).items()}
    for step in bundle.manifest.program:
        values |= {name: (tuple(port.axes or ()), np.dtype(port.dtype)) for name, port in sources_of(step).items()}
        module = modules[step.graph]
        with _fake(module) as real:
            given = [values[value] for value in step.feeds.values()]
            feeds = [torch.empty(shape, dtype=getattr(torch, str(dtype)), device="cpu") for shape, dtype in given]
            within = visit(step, module, feeds, real) or contextlib.nullcontext()
            with within, torch.inference_mode(False), torch.no_grad(), map_user_exceptions("the policy's forward()"):
                outputs = outputs_of(module(*feeds), step)
        for value, tensor in zip(step.gives.values(), outputs, strict=True):
            values[value] = (tuple(tensor.shape), np.dtype(str(tensor.dtype).removeprefix("torch.")))
        for source, target in step.carry.items():
            values[target] = values[source]


def _to_meta(torch: Any, module: Any) -> None:
    for part in module.modules():
        for name, value in part._parameters.items():
            if value is not None:
                part._parameters[name] = torch.nn.Parameter(value.detach().to("meta"), requires_grad=False)


@contextlib.contextmanager
def _parameters_on_meta(torch: Any) -> Iterator[None]:
    """Move every parameter to the meta device when a module registers it; its memory was never touched."""
    kind = torch.nn.Module
    original = kind.register_parameter

    def register(module: Any, name: str, parameter: Any) -> None:
        if parameter is not None and not parameter.is_meta:
            parameter = torch.nn.Parameter(parameter.detach().to("meta"), parameter.requires_grad)
        original(module, name, parameter)

    kind.register_parameter = register
    try:
        with _skip_drawing(torch):
            yield
    finally:
        kind.register_parameter = original


def _skip_drawing(torch: Any) -> Any:
    """Return a context in which random numbers are not drawn into tensors on the meta device, which have no storage."""
    from torch.overrides import TorchFunctionMode

    drawing = {torch.Tensor.normal_, torch.Tensor.uniform_, torch.Tensor.random_, torch.Tensor.exponential_}
    drawing |= {getattr(torch.nn.init, name) for name in DRAWING}

    class NothingDrawn(TorchFunctionMode):
        def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            tensor = args[0] if args else (kwargs or {}).get("tensor")
            if func in drawing and tensor is not None and tensor.is_meta:
                return tensor
            return func(*args, **(kwargs or {}))

    return NothingDrawn()


@contextlib.contextmanager
def _fake(module: Any) -> Iterator[dict[str, Any]]:
    """Replace parameters and buffers by fake tensors; yield the real buffers by name, under the fake mode."""
    from torch._subclasses import FakeTensorMode

    real = {name: buffer for name, buffer in module.named_buffers() if not buffer.is_meta}
    fields = [
        (held, key, value)
        for part in module.modules()
        for held in (part._parameters, part._buffers)
        for key, value in held.items()
        if value is not None
    ]
    fakes: dict[int, Any] = {}
    mode = FakeTensorMode(allow_non_fake_inputs=True)
    try:
        for held, key, value in fields:
            if id(value) not in fakes:
                fakes[id(value)] = _like(mode, value)
            held[key] = fakes[id(value)]
        with mode:
            yield real
    finally:
        for held, key, value in fields:
            held[key] = value


def _like(mode: Any, value: Any) -> Any:
    import torch

    with mode:
        fake = torch.empty(value.shape, dtype=value.dtype, device="cpu")
        return torch.nn.Parameter(fake, requires_grad=False) if isinstance(value, torch.nn.Parameter) else fake
