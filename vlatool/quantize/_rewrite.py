"""Put block-quantized weights into an ONNX graph, and list what has to be computed for them."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vlatool.quantize._blocks import Format
from vlatool.weights.shards import FLOATS, StoredTensor

if TYPE_CHECKING:
    from vlatool.quantize._fake_export import Skeleton

DOMAIN = "com.microsoft"
ALIGNED = 64
INLINE = 1024
"""Bytes up to which a constant stays in the graph."""
PART_BYTES = 1 << 24
"""Bytes of a record of a tensor that is not quantized."""


@dataclass(frozen=True)
class Layer:
    """A product with a constant weight.

    Args:
        node: The ``onnx_ir`` node.
        weight: Name of the initializer.
        rows, columns: Inputs (K) and outputs (N) of the product.
        output_first: Whether the weight is stored as (N, K), as torch does, and not as (K, N).
        bias: Value added to the product (Gemm), None without.
    """

    node: Any
    weight: str
    rows: int
    columns: int
    output_first: bool
    bias: Any = None


@dataclass(frozen=True)
class Piece:
    """A tensor of the new graph: its place within its record.

    Args:
        name: Of the initializer.
        dtype: Of ``onnx_ir.DataType``, by name.
        shape: Sizes of the axes.
        offset: First byte within the record.
        size: Bytes.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    offset: int
    size: int


@dataclass(frozen=True)
class Task:
    """What becomes of one stored tensor.

    Args:
        source: Where its bytes are.
        kind: ``blocks`` (MatMulNBits), ``qdq`` or ``copy``.
        pieces: The tensors that it becomes.
        label: Name of the layer, for reports.
        rows, columns: Inputs (K) and outputs (N) of the layer, when it is quantized.
        output_first: Whether the weight is stored as (N, K).
        dtype: Of the copy: ``F32``, ``F16`` or the source's own.
        scaled: Whether the weight is multiplied by a vector over its inputs first (AWQ); the vector is the last piece.
    """

    source: StoredTensor
    kind: Literal["blocks", "qdq", "copy"]
    pieces: tuple[Piece, ...]
    label: str
    rows: int = 0
    columns: int = 0
    output_first: bool = True
    dtype: str = ""
    scaled: bool = False

    @property
    def size(self) -> int:
        """Bytes up to the end of the last piece."""
        return max(piece.offset + piece.size for piece in self.pieces)


def layers_of(model: Any, tensors: dict[str, StoredTensor]) -> Iterator[Layer]:
    """Yield the products of activations with a two-dimensional float constant, their second operand."""
    for node in model.graph:
        if node.op_type not in ("MatMul", "Gemm") or node.domain not in ("", "ai.onnx"):
            continue
        if not _takes_rows(node.inputs[0]):
            continue
        attributes = {name: attribute.value for name, attribute in node.attributes.items()}
        plain = attributes.get("alpha", 1.0) == attributes.get("beta", 1.0) == 1.0 and not attributes.get("transA")
        operand, turned = node.inputs[1], bool(attributes.get("transB"))
        if turns_constant(operand.producer()):
            operand, turned = operand.producer().inputs[0], not turned
        tensor = tensors.get(operand.name) if operand is not None and operand.is_initializer() else None
        if tensor is None or len(tensor.shape) != 2 or tensor.dtype not in FLOATS or not plain:
            continue
        rows, columns = tensor.shape[::-1] if turned else tensor.shape
        bias = node.inputs[2] if len(node.inputs) > 2 else None
        yield Layer(node, operand.name, rows, columns, turned, bias)


def _takes_rows(operand: Any) -> bool:
    """Whether an operand is activations of two axes or more; a product of two constants is computed once."""
    return not operand.is_initializer() and (operand.shape is None or len(operand.shape) > 1)


def turns_constant(node: Any) -> bool:
    """Whether a node is the transposition of a matrix that is a constant."""
    if node is None or node.op_type != "Transpose" or not node.inputs[0].is_initializer():
        return False
    axes = node.attributes.get("perm")
    return axes is None or list(axes.value) == [1, 0]


def read_as_weight(use: Any, layers: Container[int]) -> bool:
    """Whether one of the layers, or a transposition that nothing but their weights read, is what uses a constant.

    Args:
        use: An ``onnx_ir`` usage.
        layers: ``id`` of the layers' nodes.
    """
    if id(use.node) in layers:
        return bool(use.idx == 1)
    if not turns_constant(use.node) or use.node.outputs[0].is_graph_output():
        return False
    return all(id(each.node) in layers and each.idx == 1 for each in use.node.outputs[0].uses())


def block_task(layer: Layer, source: StoredTensor, form: Format, scaled: bool) -> Task:
    """Lay out codes, scales and zero points as ``com.microsoft.MatMulNBits`` takes them."""
    count = -(-layer.rows // form.block)
    name, bits = layer.weight, form.bits
    pieces = _laid(
        (f"{name}.q{bits}", "UINT8", (layer.columns, count, form.bytes)),
        (f"{name}.scales", "FLOAT", (layer.columns, count)),
        *([] if form.symmetric else [(f"{name}.zeros", "UINT8", (layer.columns, -(-count * bits // 8)))]),
        *([(f"{name}.inputs", "FLOAT", (layer.rows,))] if scaled else []),
    )
    return _layer_task(source, "blocks", pieces, layer, scaled)


def _layer_task(
    source: StoredTensor, kind: Literal["blocks", "qdq"], pieces: tuple[Piece, ...], layer: Layer, scaled: bool
) -> Task:
    return Task(source, kind, pieces, layer.node.name, layer.rows, layer.columns, layer.output_first, scaled=scaled)


def qdq_task(layer: Layer, source: StoredTensor, form: Format, scaled: bool) -> Task:
    """Lay out codes, scales and zero points as ``DequantizeLinear`` with blocks over the first axis of (K, N) does."""
    count = -(-layer.rows // form.block)
    name, kind = layer.weight, f"{'' if form.symmetric else 'U'}INT{form.bits}"
    pieces = _laid(
        (f"{name}.q{form.bits}", kind, (layer.rows, layer.columns)),
        (f"{name}.scales", "FLOAT", (count, layer.columns)),
        *([] if form.symmetric else [(f"{name}.zeros", kind, (count, layer.columns))]),
        *([(f"{name}.inputs", "FLOAT", (layer.rows,))] if scaled else []),
    )
    return _layer_task(source, "qdq", pieces, layer, scaled)


def copy_task(name: str, source: StoredTensor, half: bool) -> Task:
    """Keep a tensor: float weights as float32, or float16 when ``half``; anything else as it is."""
    dtype = ("F16" if half else "F32") if source.dtype in FLOATS else source.dtype
    kinds = {"F32": "FLOAT", "F16": "FLOAT16", "F64": "DOUBLE", "BOOL": "BOOL"}
    letters = {"I": "INT", "U": "UINT"}
    kind = kinds.get(dtype) or f"{letters[dtype[0]]}{dtype[1:]}"
    return Task(source, "copy", _laid((name, kind, source.shape)), name, dtype=dtype)


def _laid(*tensors: tuple[str, str, tuple[int, ...]]) -> tuple[Piece, ...]:
    """Place tensors one after the other."""
    bits = {"FLOAT": 32, "FLOAT16": 16, "DOUBLE": 64, "BOOL": 8, "INT4": 4, "UINT4": 4}
    pieces, offset = [], 0
    for name, dtype, shape in tensors:
        width = bits.get(dtype) or int(dtype.lstrip("UINT"))
        size = -(-math.prod(shape) * width // 8)
        pieces.append(Piece(name, dtype, shape, offset, size))
        offset += -(-size // ALIGNED) * ALIGNED
    return tuple(pieces)


class Rewriter:
    """Replaces nodes of one graph.

    Args:
        skeleton: The graph; changed in place.
        file: External data, as the graph names it.
    """

    def __init__(self, skeleton: Skeleton, file: str) -> None:
        import onnx_ir

        self._ir = onnx_ir
        self.model = skeleton.model
        self.graph = skeleton.model.graph
        self._file = file
        self._made: dict[int, Any] = {}

    def place(self, task: Task, offset: int, folder: Path, weight: str) -> list[Any]:
        """Make the initializers of a weight whose record starts at ``offset`` of the data file and return them.

        They are named after this graph's initializer, whatever the weight is called in a graph that shares it.
        """
        values = []
        for piece in task.pieces:
            place = offset + piece.offset
            if place not in self._made:
                name = self._free(f"{weight}.{piece.name.rpartition('.')[2]}")
                tensor = self._external(name, piece, offset, folder)
                value = self._ir.Value(name=name, shape=tensor.shape, type=self._ir.TensorType(tensor.dtype))
                value.const_value = tensor
                self._made[place] = value
            values.append(self._made[place])
        return values

    def _free(self, wanted: str) -> str:
        """Return that name, or one like it where a weight is stored twice: for each way in which it is read."""
        taken = {value.name for value in self._made.values()}
        names = (wanted, *(f"{wanted}.{number}" for number in range(2, len(taken) + len(self.graph.initializers) + 3)))
        return next(name for name in names if name not in taken and name not in self.graph.initializers)

    def _external(self, name: str, piece: Piece, offset: int, folder: Path) -> Any:
        return self._ir.ExternalTensor(
            self._file,
            offset + piece.offset,
            piece.size,
            self._ir.DataType[piece.dtype],
            shape=self._ir.Shape(piece.shape),
            name=name,
            base_dir=str(folder),
        )

    def keep(self, name: str, task: Task, offset: int, folder: Path) -> None:
        """Point an initializer that stays to the data file; a table in float16 is cast back after its Gather."""
        value, piece = self.graph.initializers[name], task.pieces[0]
        value.const_value = self._external(name, piece, offset, folder)
        if piece.dtype == "FLOAT16" and value.dtype != self._ir.DataType.FLOAT16:
            value.type = self._ir.TensorType(self._ir.DataType.FLOAT16)
            for node in list(value.consumers()):
                self._cast_after(node)

    def _cast_after(self, node: Any) -> None:
        given = node.outputs[0]
        wide = self._ir.Value(name=f"{given.name}.half", shape=given.shape)
        wide.type = self._ir.TensorType(self._ir.DataType.FLOAT16)
        gather = self._ir.node("Gather", list(node.inputs), dict(_attributes(node)), outputs=[wide], name=node.name)
        cast = self._ir.node("Cast", [wide], {"to": self._ir.DataType.FLOAT}, name=f"{node.name}.float")
        self._replace(node, [gather, cast])

    def use_blocks(self, layer: Layer, values: list[Any], form: Format, accuracy: int, scaled: bool) -> None:
        """Replace a product by ``MatMulNBits`` (and an Add for a Gemm's bias)."""
        activation, nodes, values = self._scaled(layer, values, scaled)
        attributes = {"K": layer.rows, "N": layer.columns, "bits": form.bits, "block_size": form.block}
        attributes["accuracy_level"] = accuracy
        product = self._ir.node(
            "MatMulNBits", [activation, *values], attributes, domain=DOMAIN, name=layer.node.name, version=1
        )
        self._replace(layer.node, [*nodes, product, *self._added(layer, product)])
        self.model.opset_imports[DOMAIN] = 1
        self.graph.opset_imports[DOMAIN] = 1

    def use_qdq(self, layer: Layer, values: list[Any], form: Format, scaled: bool) -> None:
        """Feed a product from a blocked ``DequantizeLinear`` (opset 21)."""
        activation, nodes, values = self._scaled(layer, values, scaled)
        attributes = {"axis": 0, "block_size": form.block}
        weight = self._ir.node("DequantizeLinear", values, attributes, name=f"{layer.node.name}.dequantize")
        product = self._ir.node("MatMul", [activation, weight.outputs[0]], {}, name=layer.node.name)
        self._replace(layer.node, [*nodes, weight, product, *self._added(layer, product)])

    def _scaled(self, layer: Layer, values: list[Any], scaled: bool) -> tuple[Any, list[Any], list[Any]]:
        """Divide the activations by what the weight was multiplied with."""
        if not scaled:
            return layer.node.inputs[0], [], values
        smaller = self._ir.node("Mul", [layer.node.inputs[0], values[-1]], {}, name=f"{layer.node.name}.inputs")
        return smaller.outputs[0], [smaller], values[:-1]

    def _added(self, layer: Layer, product: Any) -> list[Any]:
        if layer.bias is None:
            return []
        return [self._ir.node("Add", [product.outputs[0], layer.bias], {}, name=f"{layer.node.name}.bias")]

    def _replace(self, node: Any, nodes: list[Any]) -> None:
        """Put nodes in the place of one; the last gives the old name and shape."""
        old, new = node.outputs[0], nodes[-1].outputs[0]
        for number, each in enumerate(nodes[:-1]):
            each.outputs[0].name = each.outputs[0].name or f"{old.name}.{number}"
        self.graph.insert_before(node, nodes)
        new.shape, new.type = old.shape, old.type
        old.replace_all_uses_with(new, replace_graph_outputs=True)
        self.graph.remove(node, safe=True)
        new.name = old.name

    def finish(self) -> None:
        """Remove transpositions and constants that nobody reads, and register the new constants."""
        for node in reversed(list(self.graph)):
            outputs = [value for value in node.outputs if value.uses() or value.is_graph_output()]
            if not outputs:
                self.graph.remove(node, safe=True)
        for value in self._made.values():
            self.graph.register_initializer(value)
        for name, value in list(self.graph.initializers.items()):
            if not value.uses() and not value.is_graph_output():
                del self.graph.initializers[name]


def _attributes(node: Any) -> Iterator[tuple[str, Any]]:
    for name, attribute in node.attributes.items():
        yield name, attribute.value


def only_gathered(value: Any) -> bool:
    """Whether a constant is read by nothing but Gather, as the table of an embedding, in the graph that holds it."""
    uses = list(value.uses())
    if not uses or value.is_graph_output():
        return False
    return all(use.node.op_type == "Gather" and use.idx == 0 and use.node.graph is value.graph for use in uses)
