"""Inputs of Linear and convolution layers, in modules and in traced modules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor

ARGUMENTS = ("input", "weight", "bias", "stride", "padding", "dilation", "groups")
"""Arguments of a convolution; a linear layer has the first three."""
PRODUCTS = ("linear", "conv1d", "conv2d")


def is_product_layer(part: Any) -> bool:
    """Return whether a part of a policy is a Linear or convolution layer, or was one before tracing."""
    torch = require("torch", "build")
    nn, graph = torch.nn, getattr(part, "graph", None)
    if not isinstance(graph, torch.fx.Graph):
        return isinstance(part, nn.Linear | nn.Conv1d | nn.Conv2d)
    return "weight" in part._parameters and any(
        getattr(node.target, "_opname", "") in PRODUCTS and getattr(node.args[1], "target", "") == "weight"
        for node in graph.nodes
    )


def observe_products(observe: Callable[[Tensor, Tensor], None]) -> Any:
    """Return a context in which every product is observed, whether a module's code or a traced graph calls it.

    Args:
        observe: Function of the weight and the rows that it is multiplied with, (N, inputs).
    """
    torch = require("torch", "build")
    functional, aten = torch.nn.functional, torch.ops.aten
    linear = {functional.linear, aten.linear.default}
    convolutions = {functional.conv1d, functional.conv2d, aten.conv1d.default, aten.conv2d.default,
                    aten.conv1d.padding, aten.conv2d.padding}  # fmt: skip

    class Observer(torch.overrides.TorchFunctionMode):  # type: ignore[misc, name-defined]
        """Intercepts products."""

        def __torch_function__(
            self, function: Any, _types: Any, arguments: tuple[Any, ...] = (), named: Mapping[str, Any] | None = None
        ) -> Any:
            named = named or {}
            if function in linear | convolutions:
                named_arguments = dict(zip(ARGUMENTS, arguments, strict=False)) | dict(named)
                observe(named_arguments["weight"], input_rows(named_arguments, is_linear=function in linear))
            return function(*arguments, **named)

    return Observer()


def input_rows(named_arguments: Mapping[str, Any], *, is_linear: bool) -> Tensor:
    """Return the rows that a weight is multiplied with: (N, inputs)."""
    inputs, weight = named_arguments["input"], named_arguments["weight"]
    if is_linear:
        rows: Tensor = inputs.reshape(-1, inputs.shape[-1])
        return rows
    size = tuple(weight.shape[2:])
    steps, holes = (_per_axis(named_arguments.get(name, 1), len(size)) for name in ("stride", "dilation"))
    pads = named_arguments.get("padding", 0)
    if isinstance(pads, str):
        pads = tuple(hole * (side - 1) // 2 if pads == "same" else 0 for hole, side in zip(holes, size, strict=True))
    pads = _per_axis(pads, len(size))
    if len(size) == 1:  # an image of one row
        inputs, size, pads, steps, holes = inputs[..., None, :], (1, *size), (0, *pads), (1, *steps), (1, *holes)
    images = inputs if inputs.dim() == 4 else inputs[None]
    return _columns(images, named_arguments.get("groups", 1), (size, holes, pads, steps))


def _columns(inputs: Tensor, groups: int, window: tuple[Any, ...]) -> Tensor:
    """Return the rows of images (N, channels, height, width); those of groups as their mean."""
    columns: Tensor = require("torch", "build").nn.functional.unfold(inputs.float(), *window)
    parts = columns.reshape(len(inputs), groups, -1, columns.shape[-1]).mean(1) if groups > 1 else columns
    return parts.transpose(1, 2).reshape(-1, parts.shape[1])


def _per_axis(value: Any, count: int) -> tuple[int, ...]:
    listed = tuple(value) if isinstance(value, tuple | list) else (value,)
    return listed * count if len(listed) == 1 else listed
