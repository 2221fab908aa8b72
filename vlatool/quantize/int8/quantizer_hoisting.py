"""Hoist quantizers in a graph for ONNX Runtime: above operators that move values, and above products with a scalar.

A quantized value is a quarter of the size, so ``Transpose`` and ``Reshape`` after the quantizer move bytes, not floats.
A product with a positive scalar (the scale of attention) followed by a quantizer is a quantizer with another scale. And
uint8 pixels are quantized already, for a quantizer with steps of 1 whose zero point is the level that was subtracted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from typing import Any

import numpy as np

from vlatool.graph.nodes import name_nodes
from vlatool.graph.onnx_graph import OnnxGraph

MOVE_OPS = ("Reshape", "Transpose", "Unsqueeze", "Squeeze", "Flatten")
"""Operators that output each input element exactly once."""
SMALLEST_NORMAL = np.finfo(np.float32).tiny


def hoist_quantizers(model: Any) -> None:
    """Hoist quantizers (``insert_qdq``) with a single scale in an ``onnx.ModelProto``, in place."""
    name_nodes(model)
    _QuantizerHoister(model).run()


class _QuantizerHoister(OnnxGraph):
    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.read_counts = Counter({name: len(nodes) for name, nodes in self.readers.items()})
        self.positions = {node.name: (number, 1) for number, node in enumerate(self.graph.node)}
        uint8 = self.onnx.TensorProto.UINT8
        self.pixels = {name for name, kind in self.types.items() if kind == uint8}
        self.pixels |= {name for name, tensor in self.constants.items() if tensor.data_type == uint8}

    def run(self) -> None:
        """Hoist each quantizer as far as possible; drop unused nodes."""
        for node in self.graph.node:
            if node.op_type == "QuantizeLinear" and len(node.input) > 2 and all(map(self.is_scalar, node.input[1:])):
                while self._hoist(node):
                    pass
        self.replace_nodes(sorted(self.graph.node, key=lambda node: self.positions[node.name]))
        self.drop_unread()

    def _hoist(self, quantize: Any) -> bool:
        """Exchange a quantizer with the node before it; return whether it may move further."""
        value = quantize.input[0]
        before = self.producers.get(value)
        if before is None:
            return False
        if before.op_type in MOVE_OPS and before.input[0] not in self.constants:
            if self.read_counts[value] != 1 or value in self.outputs:
                return False
            self._swap(before, quantize)
            return True
        if before.op_type in ("Mul", "Div"):
            return self._absorb(before, quantize)
        if frame := self._pixel_source(before, quantize):
            self.replace_reads(quantize.output[0], frame)
        return False

    def _swap(self, move: Any, quantize: Any) -> None:
        """Turn move -> quantize into quantize -> move; the name of the output stays."""
        output = quantize.output[0]
        middle = _unused_name(f"{output}.early", self.producers)
        quantize.input[0], quantize.output[0] = move.input[0], middle
        move.input[0], move.output[0] = middle, output
        self.producers[middle], self.producers[output] = quantize, move
        self.read_counts[middle] = 1
        self.positions[quantize.name] = (self.positions[move.name][0], 0)

    def _absorb(self, scaled: Any, quantize: Any) -> bool:
        """Absorb the positive scalar of a product into the scale of its quantizer; return whether possible."""
        left, right = scaled.input
        if scaled.op_type == "Mul" and left in self.constants:
            left, right = right, left
        factor = self._positive_scalar(right)
        if left in self.constants or factor is None:
            return False
        factor = factor if scaled.op_type == "Mul" else 1 / factor
        step = (self.array(quantize.input[1]).astype(np.float64) / factor).astype(np.float32)
        if not np.isfinite(step).all() or not (step >= SMALLEST_NORMAL).all():
            return False
        value = quantize.input[0]
        self.read_counts[value] -= 1
        if self.read_counts[value] or value in self.outputs:  # else the product is dropped
            self.read_counts[left] += 1
        quantize.input[0] = left
        quantize.input[1] = self.add(_unused_name(f"{quantize.output[0]}.step", self.constants), step)
        return True

    def _positive_scalar(self, name: str) -> float | None:
        """Return the value of a constant that is one positive normal float32, otherwise None."""
        if not (self.is_scalar(name) and self.is_weight(name)) or len(self.constants[name].dims) > 1:
            return None
        value = float(self.array(name).reshape(-1)[0])
        return value if np.isfinite(value) and value >= SMALLEST_NORMAL else None

    def _pixel_source(self, node: Any, quantize: Any) -> str:
        """Return the uint8 frame that a quantizer reproduces unchanged; empty otherwise."""
        step, zero = (self.array(name) for name in quantize.input[1:3])
        level = 0.0
        if node.op_type == "Sub" and node.input[1] in self.constants:
            taken = self.array(node.input[1])
            level = float(taken.reshape(-1)[0]) if taken.size == 1 else -1.0
            node = self.producers.get(node.input[0], node)
        same = zero.dtype == np.uint8 and float(step.max()) == 1 and float(zero.max()) == level
        return str(node.input[0]) if same and node.op_type == "Cast" and node.input[0] in self.pixels else ""


def _unused_name(name: str, taken: Container[str]) -> str:
    while name in taken:
        name += "_"
    return name
