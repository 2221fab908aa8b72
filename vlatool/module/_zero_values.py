"""Values that are zero where weights are zero: terms that a sum may lose without a change."""

from __future__ import annotations

from typing import Any

from vlatool.errors import require

PRODUCTS = ("linear", "matmul", "mm", "bmm", "mv", "einsum", "addmm", "baddbmm", "tensordot", "conv1d", "conv2d",
            "conv3d", "conv_transpose1d", "conv_transpose2d", "conv_transpose3d")  # fmt: skip
SCALE_OPERATORS = ("batch_norm", "group_norm", "instance_norm", "layer_norm", "rms_norm")
"""Those that multiply by a weight last."""
MOVES = ("reshape", "view", "_unsafe_view", "flatten", "unflatten", "unsqueeze", "squeeze", "permute", "transpose",
         "t", "mT", "numpy_T", "swapaxes", "swapdims", "movedim", "moveaxis", "expand", "expand_as", "repeat",
         "repeat_interleave", "tile", "clone", "contiguous", "detach", "to", "_to_copy", "alias", "lift_fresh_copy",
         "dropout", "slice", "narrow", "select", "unbind", "split", "split_with_sizes", "chunk", "tensor_split", "cat",
         "concat", "stack", "roll", "flip", "sum", "mean", "amax", "amin", "index_select", "gather", "reshape_as",
         "view_as")  # fmt: skip
"""Those that give zero for zero, and are not tagged as elementwise."""
ZERO_OPERATORS = ("zeros", "new_zeros", "zeros_like")


class ZeroValues:
    """Finds out whether the values of a graph's nodes are zero where weights are.

    Args:
        stored: nodes whose values are weights, or weights with their axes in another order.
    """

    def __init__(self, stored: set[Any]) -> None:
        self._stored, self._known = stored, dict[Any, bool]()

    def __call__(self, node: Any) -> bool:
        """Say so for one node."""
        open_ = [node]
        while open_:  # what it is computed from comes first, however deep the graph is
            missing = [each for each in open_[-1].all_input_nodes if each not in self._known]
            if missing and open_[-1] not in self._stored:
                open_.append(missing[0])
                continue
            last = open_.pop()
            self._known[last] = last in self._stored or self._is_zero(last)
        return self._known[node]

    def _is_zero(self, node: Any) -> bool:
        name = getattr(node.target, "_opname", getattr(node.target, "__name__", "")).removesuffix("_")
        inputs = [self._known[each] for each in node.all_input_nodes if _holds_tensors(each)]
        if node.op != "call_function" or name in ZERO_OPERATORS:
            return name in ZERO_OPERATORS
        if name in PRODUCTS:
            bias = node.args[0] if name in ("addmm", "baddbmm") else (*node.args, None, None, None)[2]
            return any(inputs) and (name == "einsum" or not hasattr(bias, "op") or self._known[bias])
        if name in SCALE_OPERATORS:
            return len(inputs) > 1 and all(inputs[1:])
        if name in MOVES or name == "getitem":
            return all(inputs)
        elementwise = any(tag.name == "pointwise" for tag in getattr(node.target, "tags", ()))
        return elementwise and self._gives_zero(node)

    def _gives_zero(self, node: Any) -> bool:
        """Compute an elementwise operator of zeros, and of any numbers where values are not."""
        torch = require("torch", "build")
        from torch.utils._pytree import tree_map

        def example(value: Any) -> Any:
            if not hasattr(value, "op"):
                return value
            anything = torch.tensor([0.7, -1.3, 2.1]).to(value.meta["val"].dtype)
            return anything * 0 if self._known[value] else anything

        try:
            given = node.target(*tree_map(example, tuple(node.args)), **tree_map(example, dict(node.kwargs)))
        except Exception:  # the seam: any operator
            return False
        return isinstance(given, torch.Tensor) and not bool(given.count_nonzero())


def _holds_tensors(node: Any) -> bool:
    """Tell a tensor, or several, from a size."""
    value = node.meta.get("val")
    return hasattr(value, "dtype") or isinstance(value, list | tuple)
