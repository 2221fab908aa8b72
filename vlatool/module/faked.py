"""Run a policy's program without the bytes of its weights: what its graphs do, at any size, in little memory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.data import observations_for
from vlatool.errors import SourceError, require
from vlatool.module.edits import edited, loses_units, read_edits
from vlatool.module.factory import exits_told
from vlatool.module.modules import modules_of
from vlatool.module.origin import origin_of
from vlatool.runtime.observation import ObservationEncoder

DRAWING = (
    "uniform_", "normal_", "trunc_normal_", "xavier_uniform_", "xavier_normal_", "kaiming_uniform_", "kaiming_normal_",
    "orthogonal_", "sparse_",
)  # fmt: skip
"""Functions of ``torch.nn.init`` that draw."""
Visit = Callable[[ProgramStep, Any, list[Any], dict[str, Any]], contextlib.AbstractContextManager[Any] | None]
"""Step, its module, its inputs as fake tensors, real buffers by name -> what the module runs within, if anything."""


def faked_modules(bundle: Bundle) -> dict[str, Any]:
    """Call the factory of a source bundle, every parameter on torch's meta device: graph name -> module.

    Raises:
        SourceError: when code has changed, the factory fails, or a graph has no module.
    """
    return _modules(require("torch", "build"), bundle)


def run_faked(bundle: Bundle, modules: Mapping[str, Any], visit: Visit) -> None:
    """Run the program once with fake tensors; ``visit`` is called before each step's module, under the fake mode.

    Raises:
        SourceError: when a module gives another number of outputs than the program takes.
    """
    torch = require("torch", "build")
    encode = ObservationEncoder(bundle.manifest.spec, bundle.path / "assets")
    values = {name: (np.shape(array), array.dtype) for name, array in encode(observations_for(bundle, 1)[0]).items()}
    for step in bundle.manifest.program:
        _declare(step, values)
        module = modules[step.graph]
        with _fake(module) as (mode, real):
            feeds = [_fake_tensor(torch, mode, *values[value]) for value in step.feeds.values()]
            with visit(step, module, feeds, real) or contextlib.nullcontext():
                outputs = _outputs(torch, step, module, feeds)
        for value, tensor in zip(step.gives.values(), outputs, strict=True):
            values[value] = (tuple(tensor.shape), np.dtype(str(tensor.dtype).removeprefix("torch.")))
        for source, target in step.carry.items():
            values[target] = values[source]


def _declare(step: ProgramStep, values: dict[str, Any]) -> None:
    """Add shape and dtype of what a step brings into being."""
    for name, wanted in step.noise.items():
        values[name] = (tuple(wanted["shape"]), np.dtype(np.float32))
    for name, numbers in step.schedule.items():
        whole = all(isinstance(number, int) for number in numbers)
        values[name] = ((1,), np.dtype(np.int64 if whole else np.float32))
    for name, kept in step.keep.items():
        values[name] = (tuple(kept["shape"]), np.dtype(kept.get("dtype", "float32")))


def _modules(torch: Any, bundle: Bundle) -> dict[str, Any]:
    origin = origin_of(bundle)
    origin.check((".py",))
    traced = loses_units(read_edits(bundle))  # a trace runs the module, with all that it computes
    with contextlib.nullcontext() if traced else _parameters_on_meta(torch):
        made = origin.made()
    modules = modules_of(made, (step.graph for step in bundle.manifest.program))
    modules = edited(modules, bundle, weights=False)
    for module in modules.values() if traced else ():
        _to_meta(torch, module)
    return {name: module.float() for name, module in modules.items()}


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
            parameter = torch.nn.Parameter(parameter.detach().to("meta"), requires_grad=False)
        original(module, name, parameter)

    kind.register_parameter = register
    try:
        with _nothing_drawn(torch):
            yield
    finally:
        kind.register_parameter = original


def _nothing_drawn(torch: Any) -> Any:
    """Return a context in which random numbers are not drawn into tensors on the meta device: there is no place."""
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
def _fake(module: Any) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Put fake tensors in the place of parameters and buffers; yield the mode and the real buffers by name."""
    from torch._subclasses import FakeTensorMode

    real = {name: buffer for name, buffer in module.named_buffers() if not buffer.is_meta}
    places = [
        (held, key, value)
        for part in module.modules()
        for held in (part._parameters, part._buffers)
        for key, value in held.items()
        if value is not None
    ]
    made: dict[int, Any] = {}
    mode = FakeTensorMode(allow_non_fake_inputs=True)
    try:
        for held, key, value in places:
            if id(value) not in made:
                made[id(value)] = _like(mode, value)
            held[key] = made[id(value)]
        with mode:
            yield mode, real
    finally:
        for held, key, value in places:
            held[key] = value


def _like(mode: Any, value: Any) -> Any:
    import torch

    with mode:
        fake = torch.empty(value.shape, dtype=value.dtype, device="cpu")
        return torch.nn.Parameter(fake, requires_grad=False) if isinstance(value, torch.nn.Parameter) else fake


def _fake_tensor(torch: Any, mode: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    return torch.empty(shape, dtype=getattr(torch, str(np.dtype(dtype))), device="cpu")


def _outputs(torch: Any, step: ProgramStep, module: Any, feeds: list[Any]) -> list[Any]:
    with torch.inference_mode(False), torch.no_grad(), exits_told("the policy's forward()"):
        given = module(*feeds)
    outputs = list(given) if isinstance(given, tuple | list) else [given]
    if len(outputs) != len(step.gives):
        raise SourceError(f"The module gives {len(outputs)} outputs; the program says {', '.join(step.gives)}.")
    return outputs
