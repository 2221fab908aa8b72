"""Products of torch computed as if they were quantized, with gradients that pass through the rounding."""

from __future__ import annotations

import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from vlatool.errors import require
from vlatool.training import recurrent_steps

TINY = 1e-12
"""Least step of a grid, for values that are all zero."""
BLOCK = 32
"""Weights along the inputs that share a scale in int4."""
INT8, INT4, UINT8 = 127, 15, 255
"""Steps of a grid on one side of zero (int8), and in all."""
Weights = Literal["int8", "int4"]
CHECKS = ("has_torch_function", "has_torch_function_unary", "has_torch_function_variadic")
"""What functions of torch that are written in Python ask before they run."""
PYTHON = ("torch.nn.functional", "torch.functional")
"""Modules of such functions."""
STEPS = ("gru_cell", "lstm_cell", "rnn_tanh_cell", "rnn_relu_cell", "rnn_tanh", "rnn_relu")
"""Recurrent layers that an export writes as products of their own; it leaves nn.GRU and nn.LSTM whole, in float."""


@dataclass(frozen=True)
class Product:
    """How a function of torch takes the two values that it multiplies.

    Args:
        first: place of the first one; the second one follows it.
        outputs: axis of the weight that has an output in each entry; -1 for matrices, which may be no weights.
        blocks: whether int4 rounds the weight.
    """

    first: int
    names: tuple[str, str]
    outputs: int
    blocks: bool = True

    def quantize_arguments(
        self, arguments: tuple[Any, ...], named: Mapping[str, Any], weights: Weights
    ) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Return a call's arguments with both values on their grids."""
        given = dict(enumerate(arguments)) | dict(named)
        keys = [index if index in given else name for index, name in enumerate(self.names, self.first)]
        values, weight = (given[key] for key in keys)
        if self.outputs < 0 and not _is_matrix(weight):
            return arguments, dict(named)
        if weights == "int8":
            given |= {keys[0]: per_tensor(values), keys[1]: per_channel(weight, self.outputs)}
        elif self.blocks and weight.dim() == 2:
            given[keys[1]] = in_blocks(weight) if self.outputs == 0 else in_blocks(weight.T).T
        return tuple(given[index] for index in range(len(arguments))), {name: given[name] for name in named}


PRODUCTS = {
    "linear": Product(0, ("input", "weight"), 0),
    **{f"conv{rank}d": Product(0, ("input", "weight"), 0, blocks=False) for rank in (1, 2, 3)},
    "matmul": Product(0, ("input", "other"), -1), **dict.fromkeys(("mm", "bmm"), Product(0, ("input", "mat2"), -1)),
    "addmm": Product(1, ("mat1", "mat2"), -1), "baddbmm": Product(1, ("batch1", "batch2"), -1),
}  # fmt: skip


def fake_quantization(weights: Weights) -> Any:
    """Return a context in which products with weights are computed with quantized values.

    These are linear layers and convolutions, matrices that are parameters, or views of one, and what cells and
    ``nn.RNN`` are made of: what ``quantize static-int8`` finds in an export. ``int8``: weights with a scale for each
    output channel, symmetric; what they are multiplied with as uint8, with the range of the batch. ``int4``: weights of
    matrices alone, in blocks of 32 along the inputs, each with a scale and a zero point. These are the grids of
    ``quantize static-int8`` and ``quantize weight-only``. Gradients pass through the rounding as if it were not there
    (straight-through: Bengio et al., arXiv 1308.3432; Jacob et al., arXiv 1712.05877).
    """
    torch = require("torch", "build")
    linear = torch.nn.functional.linear

    class FakeQuantization(torch.overrides.TorchFunctionMode):  # type: ignore[misc, name-defined]
        """Intercepts products, whether a module's code calls them or a traced graph does."""

        def __torch_function__(
            self, function: Any, _types: Any, arguments: tuple[Any, ...] = (), named: Mapping[str, Any] | None = None
        ) -> Any:
            named, name = named or {}, getattr(function, "__name__", "").partition(".")[0]
            if name in PRODUCTS:
                arguments, named = PRODUCTS[name].quantize_arguments(arguments, named, weights)
            elif name in STEPS:
                return getattr(recurrent_steps, name)(_rounded_linear, *arguments, **named)
            elif getattr(function, "__module__", "") in PYTHON and isinstance(function, types.FunctionType):
                with self:
                    return _without_checks(function)(*arguments, **named)
            return function(*arguments, **named)

    def _rounded_linear(*arguments: Any) -> Any:
        return linear(*PRODUCTS["linear"].quantize_arguments(arguments, {}, weights)[0])

    return FakeQuantization()


@cache
def _without_checks(function: types.FunctionType) -> Callable[..., Any]:
    """Return a function that runs where torch's own hands its call to a context: this sees the products inside."""
    given = {**function.__globals__, **dict.fromkeys(CHECKS, lambda *_: False)}
    copy = types.FunctionType(function.__code__, given, function.__name__, function.__defaults__, function.__closure__)
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _is_matrix(value: Any) -> bool:
    """Say whether a value is a parameter of two axes or more, or a view of a parameter that has so many."""
    parameter = require("torch", "build").nn.Parameter
    return value.dim() > 1 and (isinstance(value, parameter) or isinstance(value._base, parameter))


def per_channel(weight: Any, outputs: int = 0) -> Any:
    """Return weights on a symmetric int8 grid for each output; these are along an axis."""
    with require("torch", "build").no_grad():
        others = [axis for axis in range(weight.dim()) if axis != outputs % weight.dim()]
        step = weight.detach().float().abs().amax(others, keepdim=True).clamp_min(TINY) / INT8
        rounded = (weight.float() / step).round() * step
    return _straight_through(weight, rounded)


def per_tensor(values: Any) -> Any:
    """Return values on a uint8 grid over their range, which holds zero; as they are where one is NaN or infinite."""
    torch = require("torch", "build")
    with torch.no_grad():
        low, high = values.detach().float().amin().clamp_max(0), values.detach().float().amax().clamp_min(0)
        step = ((high - low) / UINT8).clamp_min(TINY)
        zero = (-low / step).round()
        rounded = (((values.float() / step).round() + zero).clamp(0, UINT8) - zero) * step
    return torch.where((high - low).isfinite(), _straight_through(values, rounded), values)


def in_blocks(weight: Any) -> Any:
    """Return weights (outputs, inputs) on an int4 grid over the range of each block, which holds zero."""
    torch = require("torch", "build")
    with torch.no_grad():
        rest = -weight.shape[1] % BLOCK
        blocks = torch.nn.functional.pad(weight.detach().float(), (0, rest)).reshape(len(weight), -1, BLOCK)
        low, high = blocks.amin(2, keepdim=True).clamp_max(0), blocks.amax(2, keepdim=True).clamp_min(0)
        step = ((high - low) / INT4).clamp_min(TINY)
        zero = (-low / step).round().clamp(0, INT4)
        rounded = (((blocks / step).round() + zero).clamp(0, INT4) - zero) * step
        rounded = rounded.reshape(len(weight), -1)[:, : weight.shape[1]]
    return _straight_through(weight, rounded)


def _straight_through(values: Any, rounded: Any) -> Any:
    """Return rounded values whose gradient is that of the values."""
    return values + (rounded.to(values.dtype) - values).detach()
