"""Products with the weights of Linear and convolution layers, of modules and of those that were traced."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor

NAMES = ("input", "weight", "bias", "stride", "padding", "dilation", "groups")
"""Arguments of a convolution, of which a linear layer has the first three."""
PRODUCTS = ("linear", "conv1d", "conv2d")


def is_product(part: Any) -> bool:
    """Say whether a part of a policy is a Linear or convolution layer, or was one before it was traced."""
    torch = require("torch", "build")
    nn, graph = torch.nn, getattr(part, "graph", None)
    if not isinstance(graph, torch.fx.Graph):
        return isinstance(part, nn.Linear | nn.Conv1d | nn.Conv2d)
    return "weight" in part._parameters and any(
        getattr(node.target, "_opname", "") in PRODUCTS and getattr(node.args[1], "target", "") == "weight"
        for node in graph.nodes
    )


def looking(look: Callable[[Tensor, Tensor], None]) -> Any:
    """Return a context in which every product is looked at, whether a module's code calls it or a traced graph does.

    Args:
        look: Is given the weight, and what it is multiplied with: a row for each product, (N, inputs).
    """
    torch = require("torch", "build")
    functional, aten = torch.nn.functional, torch.ops.aten
    linear = {functional.linear, aten.linear.default}
    convolutions = {functional.conv1d, functional.conv2d, aten.conv1d.default, aten.conv2d.default,
                    aten.conv1d.padding, aten.conv2d.padding}  # fmt: skip

    class Looking(torch.overrides.TorchFunctionMode):  # type: ignore[misc, name-defined]
        """Intercepts products."""

        def __torch_function__(
            self, function: Any, _types: Any, arguments: tuple[Any, ...] = (), named: Mapping[str, Any] | None = None
        ) -> Any:
            named = named or {}
            if function in linear | convolutions:
                stated = dict(zip(NAMES, arguments, strict=False)) | dict(named)
                look(stated["weight"], rows_of(stated, is_linear=function in linear))
            return function(*arguments, **named)

    return Looking()


def rows_of(stated: Mapping[str, Any], *, is_linear: bool) -> Tensor:
    """Return what a weight is multiplied with, a row for each product: (N, inputs).

    Args:
        stated: Arguments of the product by their names.
        is_linear: Whether it is no convolution.
    """
    given, weight = stated["input"], stated["weight"]
    if is_linear:
        rows: Tensor = given.reshape(-1, given.shape[-1])
        return rows
    size = tuple(weight.shape[2:])
    steps, holes = (_of_each(stated.get(name, 1), len(size)) for name in ("stride", "dilation"))
    pads = stated.get("padding", 0)
    if isinstance(pads, str):
        pads = tuple(hole * (side - 1) // 2 if pads == "same" else 0 for hole, side in zip(holes, size, strict=True))
    pads = _of_each(pads, len(size))
    if len(size) == 1:  # a picture of one row
        given, size, pads, steps, holes = given[..., None, :], (1, *size), (0, *pads), (1, *steps), (1, *holes)
    return _columns(given if given.dim() == 4 else given[None], stated.get("groups", 1), (size, holes, pads, steps))


def _columns(given: Tensor, groups: int, window: tuple[Any, ...]) -> Tensor:
    """Return the rows of pictures (N, channels, height, width); those of groups as their mean."""
    columns: Tensor = require("torch", "build").nn.functional.unfold(given.float(), *window)
    parts = columns.reshape(len(given), groups, -1, columns.shape[-1]).mean(1) if groups > 1 else columns
    return parts.transpose(1, 2).reshape(-1, parts.shape[1])


def _of_each(value: Any, count: int) -> tuple[int, ...]:
    listed = tuple(value) if isinstance(value, tuple | list) else (value,)
    return listed * count if len(listed) == 1 else listed
