"""Quantize early in a graph of ONNX Runtime: before values are moved, and without the scalars that they are scaled by.

A quantized value is a quarter of the size, so ``Transpose`` and ``Reshape`` after the quantizer move bytes, not floats.
A product with a positive scalar (the scale of attention) before a quantizer is a quantizer with another scale. And
uint8 pixels are quantized already, where a quantizer takes steps of 1 and its zero point is what was subtracted.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from vlatool.errors import require
from vlatool.graph.nodes import name_nodes, read_names, reads
from vlatool.graph.types import inferred_values

MOVES = ("Reshape", "Transpose", "Unsqueeze", "Squeeze", "Flatten")
"""Operators that give all values that they take, each once."""


def quantize_early(model: Any) -> None:
    """Move quantizers with one scale up in a graph, in place.

    Args:
        model: An ``onnx.ModelProto`` whose quantizers are made (``insert_qdq``).
    """
    name_nodes(model)
    _Raiser(model).run()


class _Raiser:
    def __init__(self, model: Any) -> None:
        self.onnx = require("onnx", "build")
        self.graph = model.graph
        self.constants = {tensor.name: tensor for tensor in model.graph.initializer}
        self.outputs = {value.name for value in model.graph.output}
        self.readers = Counter(name for node in model.graph.node for name in reads(node))
        self.producers = {name: node for node in model.graph.node for name in node.output}
        self.places = {node.name: (number, 1) for number, node in enumerate(model.graph.node)}
        uint8 = self.onnx.TensorProto.UINT8
        self.pixels = {tensor.name for tensor in model.graph.initializer if tensor.data_type == uint8}
        self.pixels |= {value.name for value in inferred_values(model) if value.type.tensor_type.elem_type == uint8}

    def run(self) -> None:
        """Raise each quantizer until it can go no further."""
        for node in [node for node in self.graph.node if node.op_type == "QuantizeLinear" and self._one_scale(node)]:
            while self._raised(node):
                pass
        self._finish()

    def _raised(self, quantize: Any) -> bool:
        """Change a quantizer and what is before it; say whether there may be more to do."""
        value = quantize.input[0]
        before = self.producers.get(value)
        if before is None:
            return False
        if before.op_type in MOVES and before.input[0] not in self.constants:
            if self.readers[value] != 1 or value in self.outputs:
                return False
            self._swap(before, quantize)
            return True
        if before.op_type in ("Mul", "Div"):
            return self._absorb(before, quantize)
        frame = self._frame(before, quantize)
        if frame:
            self._read_pixels(frame, quantize.output[0])
        return False

    def _one_scale(self, node: Any) -> bool:
        if len(node.input) < 3 or node.input[1] not in self.constants or node.input[2] not in self.constants:
            return False
        return all(not [axis for axis in self.constants[name].dims if axis != 1] for name in node.input[1:3])

    def _swap(self, move: Any, quantize: Any) -> None:
        """Turn move -> quantize into quantize -> move; the name of what is given stays."""
        given, middle = quantize.output[0], f"{quantize.output[0]}.early"
        while middle in self.producers:
            middle += "_"
        quantize.input[0], quantize.output[0] = move.input[0], middle
        move.input[0], move.output[0] = middle, given
        self.producers[middle], self.producers[given] = quantize, move
        self.readers[middle] = 1
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
        step = self.onnx.numpy_helper.to_array(self.constants[quantize.input[1]]).astype(np.float64) / factor
        narrow = step.astype(np.float32)
        if not np.isfinite(narrow).all() or not (narrow >= np.finfo(np.float32).tiny).all():
            return False
        name = f"{quantize.output[0]}.step"
        while name in self.constants:
            name += "_"
        self.constants[name] = self.onnx.numpy_helper.from_array(narrow, name)
        self.readers[quantize.input[0]] -= 1
        if self.readers[quantize.input[0]] or quantize.input[0] in self.outputs:  # else the product is dropped
            self.readers[left] += 1
        quantize.input[0], quantize.input[1] = left, name
        return True

    def _scalar(self, name: str) -> float | None:
        """Return a constant that is one positive normal float32, else None."""
        tensor = self.constants.get(name)
        if tensor is None or [axis for axis in tensor.dims if axis != 1] or len(tensor.dims) > 1:
            return None
        if tensor.data_type != self.onnx.TensorProto.FLOAT:
            return None
        value = float(self.onnx.numpy_helper.to_array(tensor).reshape(-1)[0])
        return value if np.isfinite(value) and value >= np.finfo(np.float32).tiny else None

    def _frame(self, node: Any, quantize: Any) -> str:
        """Return the frame of uint8 that a quantizer reads and gives as it is; nothing where it does not."""
        step, zero = (self.onnx.numpy_helper.to_array(self.constants[name]) for name in quantize.input[1:3])
        level = 0.0
        if node.op_type == "Sub" and node.input[1] in self.constants:
            taken = self.onnx.numpy_helper.to_array(self.constants[node.input[1]])
            level = float(taken.reshape(-1)[0]) if taken.size == 1 else -1.0
            node = self.producers.get(node.input[0], node)
        same = zero.dtype == np.uint8 and float(step.max()) == 1 and float(zero.max()) == level
        return str(node.input[0]) if same and node.op_type == "Cast" and node.input[0] in self.pixels else ""

    def _read_pixels(self, frame: str, quantized: str) -> None:
        for node in self.graph.node:
            for index, name in enumerate(node.input):
                if name == quantized:
                    node.input[index] = frame

    def _finish(self) -> None:
        """Drop what nobody reads any more."""
        wanted = set(self.outputs)
        kept = []
        for node in sorted(self.graph.node, key=lambda node: self.places[node.name], reverse=True):
            if any(name in wanted for name in node.output):
                kept.append(node)
                wanted |= read_names([node])
        del self.graph.node[:]
        self.graph.node.extend(reversed(kept))
        del self.graph.initializer[:]
        self.graph.initializer.extend(tensor for name, tensor in self.constants.items() if name in wanted)
