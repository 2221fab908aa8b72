"""Products of torch computed as if they were quantized, with gradients that pass through the rounding."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from vlatool.errors import require

TINY = 1e-12
"""Least step of a grid, for values that are all zero."""
BLOCK = 32
"""Weights along the inputs that share a scale in int4."""
INT8, INT4, UINT8 = 127, 15, 255
"""Steps of a grid on one side of zero (int8), and in all."""
Weights = Literal["int8", "int4"]


def fake_quantization(weights: Weights) -> Any:
    """Return a context in which linear layers and convolutions compute with quantized values.

    ``int8``: weights with a scale for each output channel, symmetric; what they are multiplied with as uint8, with the
    range of the batch. ``int4``: weights of linear layers alone, in blocks of 32 along the inputs, each with a scale
    and a zero point. These are the grids of ``quantize static-int8`` and ``quantize weight-only``. Gradients pass
    through the rounding as if it were not there (straight-through: Bengio et al., arXiv 1308.3432; Jacob et al.,
    arXiv 1712.05877).
    """
    torch = require("torch", "build")
    aten, functional = torch.ops.aten, torch.nn.functional
    linear = {functional.linear, aten.linear.default}
    convolutions = {functional.conv1d, functional.conv2d, functional.conv3d,
                    aten.conv1d.default, aten.conv2d.default, aten.conv3d.default}  # fmt: skip

    class FakeQuantization(torch.overrides.TorchFunctionMode):  # type: ignore[misc, name-defined]
        """Intercepts products, whether a module's code calls them or a traced graph does."""

        def __torch_function__(
            self, function: Any, _types: Any, arguments: tuple[Any, ...] = (), named: Mapping[str, Any] | None = None
        ) -> Any:
            named = named or {}
            if len(arguments) > 1 and function in linear and weights == "int4":
                arguments = (arguments[0], in_blocks(arguments[1]), *arguments[2:])
            elif len(arguments) > 1 and function in linear | convolutions and weights == "int8":
                arguments = (per_tensor(arguments[0]), per_channel(arguments[1]), *arguments[2:])
            return function(*arguments, **named)

    return FakeQuantization()


def per_channel(weight: Any) -> Any:
    """Return weights (outputs, ...) on a symmetric int8 grid for each output."""
    with require("torch", "build").no_grad():
        step = weight.detach().float().flatten(1).abs().amax(1).clamp_min(TINY) / INT8
        step = step.reshape(-1, *[1] * (weight.dim() - 1))
        rounded = (weight.float() / step).round() * step
    return _through(weight, rounded)


def per_tensor(values: Any) -> Any:
    """Return values on a uint8 grid over their range, which holds zero; as they are where one is NaN or infinite."""
    torch = require("torch", "build")
    with torch.no_grad():
        low, high = values.detach().float().amin().clamp_max(0), values.detach().float().amax().clamp_min(0)
        step = ((high - low) / UINT8).clamp_min(TINY)
        zero = (-low / step).round()
        rounded = (((values.float() / step).round() + zero).clamp(0, UINT8) - zero) * step
    return torch.where((high - low).isfinite(), _through(values, rounded), values)


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
    return _through(weight, rounded)


def _through(values: Any, rounded: Any) -> Any:
    """Return rounded values whose gradient is that of the values."""
    return values + (rounded.to(values.dtype) - values).detach()
