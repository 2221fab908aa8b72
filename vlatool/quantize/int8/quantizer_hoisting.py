"""Quantize early in a graph of ONNX Runtime: before values are moved, and without the scalars that they are scaled by.

A quantized value is a quarter of the size, so ``Transpose`` and ``Reshape`` after the quantizer move bytes, not floats.
A product with a positive scalar (the scale of attention) before a quantizer is a quantizer with another scale. And
uint8 pixels are quantized already, where a quantizer takes steps of 1 and its zero point is what was subtracted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from typing import Any

import numpy as np

from vlatool.graph.nodes import name_nodes
from vlatool.graph.onnx_graph import OnnxGraph

MOVES = ("Reshape", "Transpose", "Unsqueeze", "Squeeze", "Flatten")
"""Operators that give all values that they take, each once."""
TINY = np.finfo(np.float32).tiny


def quantize_early(model: Any) -> None:
    """Move quantizers with one scale up in a graph, in place.

    Args:
        model: An ``onnx.ModelProto`` whose quantizers are made (``insert_qdq``).
    """
    name_nodes(model)
    _Raiser(model).run()


class _Raiser(OnnxGraph):
    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.reads = Counter({name: len(nodes) for name, nodes in self.readers.items()})
        self.places = {node.name: (number, 1) for number, node in enumerate(self.graph.node)}
        uint8 = self.onnx.TensorProto.UINT8
        self.pixels = {name for name, kind in self.types.items() if kind == uint8}
        self.pixels |= {name for name, tensor in self.constants.items() if tensor.data_type == uint8}

    def run(self) -> None:
        """Raise each quantizer until it can go no further; drop what nobody reads any more."""
        for node in self.graph.node:
            if node.op_type == "QuantizeLinear" and len(node.input) > 2 and all(map(self.is_scalar, node.input[1:])):
                while self._raised(node):
                    pass
        self.replace_nodes(sorted(self.graph.node, key=lambda node: self.places[node.name]))
        self.drop_unread()

    def _raised(self, quantize: Any) -> bool:
        """Change a quantizer and what is before it; say whether there may be more to do."""
        value = quantize.input[0]
        before = self.producers.get(value)
        if before is None:
            return False
        if before.op_type in MOVES and before.input[0] not in self.constants:
            if self.reads[value] != 1 or value in self.outputs:
                return False
            self._swap(before, quantize)
            return True
        if before.op_type in ("Mul", "Div"):
            return self._absorb(before, quantize)
        if frame := self._frame(before, quantize):
            self.replace_reads(quantize.output[0], frame)
        return False

    def _swap(self, move: Any, quantize: Any) -> None:
        """Turn move -> quantize into quantize -> move; the name of what they give stays."""
        output = quantize.output[0]
        middle = _unused(f"{output}.early", self.producers)
        quantize.input[0], quantize.output[0] = move.input[0], middle
        move.input[0], move.output[0] = middle, output
        self.producers[middle], self.producers[output] = quantize, move
        self.reads[middle] = 1
        self.places[quantize.name] = (self.places[move.name][0], 0)

    def _absorb(self, scaled: Any, quantize: Any) -> bool:
        """Read what a positive scalar multiplies, with the scale divided by it; say whether it could be."""
        left, right = scaled.input
        if scaled.op_type == "Mul" and left in self.constants:
            left, right = right, left
        factor = self._scalar(right)
        if left in self.constants or factor is None:
            return False
        factor = factor if scaled.op_type == "Mul" else 1 / factor
        step = (self.array(quantize.input[1]).astype(np.float64) / factor).astype(np.float32)
        if not np.isfinite(step).all() or not (step >= TINY).all():
            return False
        value = quantize.input[0]
        self.reads[value] -= 1
        if self.reads[value] or value in self.outputs:  # else the product is dropped
            self.reads[left] += 1
        quantize.input[0] = left
        quantize.input[1] = self.add(_unused(f"{quantize.output[0]}.step", self.constants), step)
        return True

    def _scalar(self, name: str) -> float | None:
        """Return a constant that is one positive normal float32, else None."""
        if not (self.is_scalar(name) and self.is_weight(name)) or len(self.constants[name].dims) > 1:
            return None
        value = float(self.array(name).reshape(-1)[0])
        return value if np.isfinite(value) and value >= TINY else None

    def _frame(self, node: Any, quantize: Any) -> str:
        """Return the frame of uint8 that a quantizer reads and gives as it is; nothing where it does not."""
        step, zero = (self.array(name) for name in quantize.input[1:3])
        level = 0.0
        if node.op_type == "Sub" and node.input[1] in self.constants:
            taken = self.array(node.input[1])
            level = float(taken.reshape(-1)[0]) if taken.size == 1 else -1.0
            node = self.producers.get(node.input[0], node)
        same = zero.dtype == np.uint8 and float(step.max()) == 1 and float(zero.max()) == level
        return str(node.input[0]) if same and node.op_type == "Cast" and node.input[0] in self.pixels else ""


def _unused(name: str, taken: Container[str]) -> str:
    while name in taken:
        name += "_"
    return name
