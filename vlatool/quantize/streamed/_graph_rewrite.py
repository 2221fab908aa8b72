"""Put block-quantized weights into an ONNX graph, and list the computations for them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vlatool.quantize.streamed._block_quantization import BlockFormat
from vlatool.weights.shards import FLOATS, StoredTensor

if TYPE_CHECKING:
    from vlatool.quantize.streamed._weightless_export import GraphTemplate

ORT_DOMAIN = "com.microsoft"
ALIGNMENT = 64
MAX_INLINE_BYTES = 1024
"""Largest constant that stays in the graph, in bytes."""
PART_BYTES = 1 << 24
"""Bytes of each record of a tensor that is not quantized."""


@dataclass(frozen=True)
class Product:
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
    """A tensor of the new graph within its record.

    Args:
        name: Name of the initializer.
        dtype: Name of an ``onnx_ir.DataType``.
        offset: First byte within the record.
        size: Size in bytes.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    offset: int
    size: int


@dataclass(frozen=True)
class Task:
    """Conversion of one stored tensor.

    Args:
        kind: ``blocks`` (MatMulNBits), ``qdq`` or ``copy``.
        rows, columns: Inputs (K) and outputs (N) of the layer, when it is quantized.
        output_first: Whether the weight is stored as (N, K).
        dtype: Type of the copy: ``F32``, ``F16`` or that of the source.
        scaled: Whether the weight is first multiplied by a vector over its inputs (AWQ), which is then the last piece.
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


def find_products(model: Any, tensors: dict[str, StoredTensor]) -> Iterator[Product]:
    """Yield the products of activations with a two-dimensional float constant as second operand."""
    for node in model.graph:
        if node.op_type not in ("MatMul", "Gemm") or node.domain not in ("", "ai.onnx"):
            continue
        factor = node.inputs[0]
        if factor.is_initializer() or (factor.shape is not None and len(factor.shape) < 2):
            continue  # products of two constants are computed once, those of a vector have no matrix of activations
        attributes = {name: attribute.value for name, attribute in node.attributes.items()}
        plain = attributes.get("alpha", 1.0) == attributes.get("beta", 1.0) == 1.0 and not attributes.get("transA")
        operand, transposed = node.inputs[1], bool(attributes.get("transB"))
        if transposes_constant(operand.producer()):
            operand, transposed = operand.producer().inputs[0], not transposed
        tensor = tensors.get(operand.name) if operand is not None and operand.is_initializer() else None
        if tensor is None or len(tensor.shape) != 2 or tensor.dtype not in FLOATS or not plain:
            continue
        rows, columns = tensor.shape[::-1] if transposed else tensor.shape
        bias = node.inputs[2] if len(node.inputs) > 2 else None
        yield Product(node, operand.name, rows, columns, transposed, bias)


def transposes_constant(node: Any) -> bool:
    """Return whether a node transposes a constant matrix."""
    if node is None or node.op_type != "Transpose" or not node.inputs[0].is_initializer():
        return False
    axes = node.attributes.get("perm")
    return axes is None or list(axes.value) == [1, 0]


def is_weight_use(use: Any, layers: Container[int]) -> bool:
    """Return whether a constant is used as the weight of one of the layers, directly or through its own transposition.

    Args:
        use: An ``onnx_ir`` usage.
        layers: ``id`` of the nodes of the products.
    """
    if id(use.node) in layers:
        return bool(use.idx == 1)
    if not transposes_constant(use.node) or use.node.outputs[0].is_graph_output():
        return False
    return all(id(reader.node) in layers and reader.idx == 1 for reader in use.node.outputs[0].uses())


def weight_task(product: Product, source: StoredTensor, form: BlockFormat, layout: str, scaled: bool) -> Task:
    """Lay out codes, scales and zero points as ``com.microsoft.MatMulNBits`` takes them (``ort``), or (``qdq``) as
    ``DequantizeLinear`` with blocks over the first axis of (K, N) does.
    """
    name, rows, columns = product.weight, product.rows, product.columns
    count = -(-rows // form.block)
    kind: Literal["blocks", "qdq"] = "blocks" if layout == "ort" else "qdq"
    codes: tuple[int, ...]
    if kind == "blocks":
        dtype, codes, zeros = "UINT8", (columns, count, form.code_bytes), (columns, -(-count * form.bits // 8))
    else:
        dtype, codes, zeros = f"{'' if form.symmetric else 'U'}INT{form.bits}", (rows, columns), (count, columns)
    pieces = _lay_out(
        (f"{name}.q{form.bits}", dtype, codes),
        (f"{name}.scales", "FLOAT", (columns, count) if kind == "blocks" else (count, columns)),
        *([(f"{name}.zeros", dtype, zeros)] if stores_zeros(kind, form) else []),
        *([(f"{name}.inputs", "FLOAT", (rows,))] if scaled else []),
    )
    return Task(source, kind, pieces, product.node.name, rows, columns, product.output_first, scaled=scaled)


def stores_zeros(kind: str, form: BlockFormat) -> bool:
    """Return whether zero points are stored: asymmetric ones, and 0 for a DequantizeLinear of int8.

    Where int8 products saturate, ONNX Runtime (1.32, with the option that makes them exact) adds a zero point without
    blocks to such a node, and then refuses to run it.
    """
    return not form.symmetric or (kind == "qdq" and form.bits == 8)


def copy_task(name: str, source: StoredTensor, half: bool) -> Task:
    """Return the task that copies a tensor: float weights as float32, or float16 when ``half``; others unchanged."""
    dtype = ("F16" if half else "F32") if source.dtype in FLOATS else source.dtype
    kinds = {"F32": "FLOAT", "F16": "FLOAT16", "F64": "DOUBLE", "BOOL": "BOOL"}
    letters = {"I": "INT", "U": "UINT"}
    kind = kinds.get(dtype) or f"{letters[dtype[0]]}{dtype[1:]}"
    return Task(source, "copy", _lay_out((name, kind, source.shape)), name, dtype=dtype)


def _lay_out(*tensors: tuple[str, str, tuple[int, ...]]) -> tuple[Piece, ...]:
    """Lay out tensors one after the other."""
    bits = {"FLOAT": 32, "FLOAT16": 16, "DOUBLE": 64, "BOOL": 8, "INT4": 4, "UINT4": 4}
    pieces, offset = [], 0
    for name, dtype, shape in tensors:
        width = bits.get(dtype) or int(dtype.lstrip("UINT"))
        size = -(-math.prod(shape) * width // 8)
        pieces.append(Piece(name, dtype, shape, offset, size))
        offset += -(-size // ALIGNMENT) * ALIGNMENT
    return tuple(pieces)


class GraphRewriter:
    """Replaces nodes of one graph.

    Args:
        template: The graph; changed in place.
        file: External data, as the graph names it.
    """

    def __init__(self, template: GraphTemplate, file: str) -> None:
        import onnx_ir

        self._ir = onnx_ir
        self.model = template.model
        self.graph = template.model.graph
        self._file = file
        self._values: dict[int, Any] = {}

    def add_initializers(self, task: Task, offset: int, folder: Path, weight: str) -> list[Any]:
        """Create the initializers of a weight whose record starts at ``offset`` of the data file and return them.

        They are named after this graph's initializer, even where another graph shares the weight under another name.
        """
        values = []
        for piece in task.pieces:
            position = offset + piece.offset
            if position not in self._values:
                name = self._unique_name(f"{weight}.{piece.name.rpartition('.')[2]}")
                tensor = self._external(name, piece, offset, folder)
                value = self._ir.Value(name=name, shape=tensor.shape, type=self._ir.TensorType(tensor.dtype))
                value.const_value = tensor
                self._values[position] = value
            values.append(self._values[position])
        return values

    def _unique_name(self, name: str) -> str:
        """Return the name, with a number where a weight is stored in several layouts."""
        taken = {*self.graph.initializers, *(value.name for value in self._values.values())}
        names = itertools.chain([name], (f"{name}.{number}" for number in itertools.count(2)))
        return next(name for name in names if name not in taken)

    def _external(self, name: str, piece: Piece, offset: int, folder: Path) -> Any:
        dtype, shape = self._ir.DataType[piece.dtype], self._ir.Shape(piece.shape)
        return self._ir.ExternalTensor(
            self._file, offset + piece.offset, piece.size, dtype, shape=shape, name=name, base_dir=str(folder)
        )

    def keep_initializer(self, name: str, task: Task, offset: int, folder: Path) -> None:
        """Point a kept initializer to the data file; a table in float16 is cast back after its Gather."""
        value, piece = self.graph.initializers[name], task.pieces[0]
        value.const_value = self._external(name, piece, offset, folder)
        if piece.dtype == "FLOAT16" and value.dtype != self._ir.DataType.FLOAT16:
            value.type = self._ir.TensorType(self._ir.DataType.FLOAT16)
            for node in list(value.consumers()):
                self._cast_after(node)

    def _cast_after(self, node: Any) -> None:
        table = node.outputs[0]
        wide = self._ir.Value(name=f"{table.name}.half", shape=table.shape)
        wide.type = self._ir.TensorType(self._ir.DataType.FLOAT16)
        options = {name: attribute.value for name, attribute in node.attributes.items()}
        gather = self._ir.node("Gather", list(node.inputs), options, outputs=[wide], name=node.name)
        cast = self._ir.node("Cast", [wide], {"to": self._ir.DataType.FLOAT}, name=f"{node.name}.float")
        self._replace(node, [gather, cast])

    def quantize(self, product: Product, task: Task, values: list[Any], form: BlockFormat, accuracy: int) -> None:
        """Replace a product by ``MatMulNBits``, or feed it from a blocked ``DequantizeLinear`` (opset 21).

        Args:
            product: Product to replace; the bias of a Gemm becomes an Add.
            task: Task of its weight; where that was scaled by a vector, the activations are divided by it first.
            values: Initializers from ``add_initializers``.
            accuracy: ``accuracy_level`` of ``MatMulNBits``.
        """
        make, name, activation, nodes = self._ir.node, product.node.name, product.node.inputs[0], []
        if task.scaled:
            nodes.append(make("Mul", [activation, values[-1]], {}, name=f"{name}.inputs"))
            activation, values = nodes[0].outputs[0], values[:-1]
        if task.kind == "qdq":
            options = {"axis": 0, "block_size": form.block}
            nodes.append(make("DequantizeLinear", values, options, name=f"{name}.dequantize"))
            nodes.append(make("MatMul", [activation, nodes[-1].outputs[0]], {}, name=name))
        else:
            options = {"K": product.rows, "N": product.columns, "bits": form.bits, "block_size": form.block}
            options["accuracy_level"] = accuracy
            nodes.append(make("MatMulNBits", [activation, *values], options, domain=ORT_DOMAIN, name=name, version=1))
            self.model.opset_imports[ORT_DOMAIN] = self.graph.opset_imports[ORT_DOMAIN] = 1
        if product.bias is not None:
            nodes.append(make("Add", [nodes[-1].outputs[0], product.bias], {}, name=f"{name}.bias"))
        self._replace(product.node, nodes)

    def _replace(self, node: Any, nodes: list[Any]) -> None:
        """Replace a node by several; the last one takes over name and shape of the output."""
        old = node.outputs[0]
        for number, inner in enumerate(nodes[:-1]):
            inner.outputs[0].name = inner.outputs[0].name or f"{old.name}.{number}"
        self._ir.convenience.replace_nodes_and_values(self.graph, node, [node], nodes, [old], nodes[-1].outputs)

    def finish(self) -> None:
        """Remove unused transpositions and constants, and register the new constants."""
        for node in reversed(list(self.graph)):
            if not any(value.uses() or value.is_graph_output() for value in node.outputs):
                self.graph.remove(node, safe=True)
        for value in self._values.values():
            self.graph.register_initializer(value)
        for name, value in list(self.graph.initializers.items()):
            if not value.uses() and not value.is_graph_output():
                del self.graph.initializers[name]


def is_lookup_table(value: Any) -> bool:
    """Return whether only Gather reads a constant, as the table of an embedding, in the graph that holds it."""
    uses = list(value.uses())
    if not uses or value.is_graph_output():
        return False
    return all(use.node.op_type == "Gather" and use.idx == 0 and use.node.graph is value.graph for use in uses)
