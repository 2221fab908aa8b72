"""Random small ONNX graphs, with what exporters and people write: every kind of layer, constants, shared weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SAMPLES = 12


class RandomGraph:
    """One graph, drawn from a seed, that maps one or two inputs to one to three outputs.

    Args:
        seed: Of everything that is drawn.
    """

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}
        self.inputs: dict[str, tuple[tuple[int, ...], str]] = {}
        self.outputs: list[str] = []
        self.shapes: dict[str, tuple[int, ...]] = {}
        self.words: list[str] = []
        self.opset = int(self.random.choice([17, 18, 20, 21]))
        self.named = bool(self.random.random() < 0.8)
        self._draw()

    @property
    def model(self) -> Any:
        """The ``onnx.ModelProto``, checked."""
        inputs = [
            helper.make_tensor_value_info(name, KINDS[kind], shape) for name, (shape, kind) in self.inputs.items()
        ]
        outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, self.shapes[name]) for name in self.outputs]
        graph = helper.make_graph(self.nodes, "random", inputs, outputs, list(self.constants.values()))
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", self.opset)], ir_version=10)
        onnx.checker.check_model(made, full_check=True)
        return made

    def recording(self, samples: int = SAMPLES, seed: int = 0) -> dict[str, np.ndarray]:
        """Return input name -> (samples, axes without the batch) of what the graph may read."""
        random = np.random.default_rng(seed)
        return {name: drawn(random, (samples, *shape), kind) for name, (shape, kind) in self.inputs.items()}

    def node(self, kind: str, inputs: Iterable[str], shape: tuple[int, ...], **attributes: Any) -> str:
        """Add a node with one output and return that."""
        name = f"v{len(self.nodes)}"
        label = f"block{len(self.words)}/{kind}_{len(self.nodes)}" if self.named else ""
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=label, **attributes))
        self.shapes[name] = shape
        return name

    def constant(self, values: Any, dtype: Any = np.float32) -> str:
        """Add a constant and return its name."""
        name = f"w{len(self.constants)}"
        array = np.asarray(values, dtype)
        self.constants[name] = numpy_helper.from_array(array, name)
        self.shapes[name] = array.shape
        return name

    def weight(self, *shape: int, fan: int | None = None) -> str:
        """Add a weight that keeps the size of what it is multiplied with."""
        fan = fan or shape[0]
        return self.constant(self.random.normal(size=shape) / np.sqrt(fan))

    def pick(self, *choices: Any) -> Any:
        """Return one of several."""
        return choices[int(self.random.integers(len(choices)))]

    def given(self, shape: tuple[int, ...], kind: str = "float32") -> str:
        """Add an input and return its name."""
        name = f"input{len(self.inputs)}"
        self.inputs[name] = (shape, kind)
        self.shapes[name] = shape
        return name

    def _draw(self) -> None:
        value = self.pick(_vector, _rows, _tokens, _frame, _signal, _volume, _ids)(self)
        heads = []
        for _ in range(int(self.random.integers(1, 6))):
            block = self.pick(*BLOCKS[len(self.shapes[value])])
            self.words.append(block.__name__.strip("_"))
            value = block(self, value)
            if self.random.random() < 0.15:
                heads.append(value)
        if self.random.random() < 0.5:
            value = _flat(self, value)
            self.words.append("last_linear")
            value = self.pick(_linear, _gemm, _two_heads, _turned)(self, value)
        found = dict.fromkeys([value, *(head for head in heads if self.random.random() < 0.5)])
        self.outputs.extend(name for name in found if name not in self.inputs)
        if self.random.random() < 0.1 and self.constants:
            self._give_weight()
        if not self.outputs:
            self.outputs.append(self.node("Relu", [value], self.shapes[value]))

    def _give_weight(self) -> None:
        """Make a weight an output of the graph, as tied tables are in some exports."""
        floats = [name for name, item in self.constants.items() if item.data_type == 1 and len(item.dims) == 2]
        if floats:
            self.words.append("weight_is_output")
            self.outputs.append(self.pick(*floats))


KINDS = {"float32": TensorProto.FLOAT, "uint8": TensorProto.UINT8, "int64": TensorProto.INT64}
WORDS = 11
"""Entries of the tables of words."""
WIDE = 512
"""Elements up to which an axis is flattened."""


def drawn(random: Any, shape: tuple[int, ...], kind: str) -> np.ndarray:
    """Draw what an input may hold; the first axis counts samples, and a batch axis of one is dropped."""
    shape = (shape[0], *shape[2:]) if len(shape) > 2 and shape[1] == 1 else shape
    if kind == "uint8":
        return random.integers(0, 256, shape, np.uint8)
    if kind == "int64":
        return random.integers(0, WORDS, shape)
    return random.normal(size=shape).astype(np.float32)


def _vector(g: RandomGraph) -> str:
    return g.given((1, g.pick(3, 16, 33, 64)))


def _rows(g: RandomGraph) -> str:
    """Rows without a batch axis."""
    count, width = g.pick(2, 5), g.pick(16, 40)
    return g.node("Squeeze", [g.given((1, count, width)), g.constant([0], np.int64)], (count, width))


def _tokens(g: RandomGraph) -> str:
    return g.given((1, g.pick(4, 6), g.pick(16, 32)))


def _signal(g: RandomGraph) -> str:
    return g.given((1, g.pick(4, 16), g.pick(8, 16)))


def _volume(g: RandomGraph) -> str:
    return g.given((1, 3, 4, 8, 8))


def _ids(g: RandomGraph) -> str:
    count = g.pick(4, 6)
    table = g.constant(g.random.normal(size=(WORDS, 32)))
    tokens = g.node("Gather", [table, g.given((1, count), "int64")], (1, count, 32))
    if g.random.random() < 0.4:  # the head of a language model, tied to its table
        turned = g.node("Transpose", [table], (32, WORDS), perm=[1, 0])
        g.outputs.append(g.node("MatMul", [tokens, turned], (1, count, WORDS)))
    return tokens


def _frame(g: RandomGraph) -> str:
    if g.random.random() < 0.5:
        return g.given((1, 3, 16, 16))
    frame = g.given((1, 16, 16, 3), "uint8")
    wide = g.node("Cast", [frame], (1, 16, 16, 3), to=TensorProto.FLOAT)
    turned = g.node("Transpose", [wide], (1, 3, 16, 16), perm=[0, 3, 1, 2])
    small = g.node("Div", [turned, g.constant(127.5)], (1, 3, 16, 16))
    return g.node("Sub", [small, g.constant(1.0)], (1, 3, 16, 16))


def _linear(g: RandomGraph, value: str) -> str:
    """MatMul, and a sum with a bias in most cases."""
    shape = g.shapes[value]
    out = g.pick(8, 17, 32, 64)
    value = g.node("MatMul", [value, g.weight(shape[-1], out)], (*shape[:-1], out))
    if g.random.random() < 0.6:
        value = g.node("Add", [value, g.constant(g.random.normal(size=out) / 4)], g.shapes[value])
    return value


def _turned(g: RandomGraph, value: str) -> str:
    """A product with a transposed weight, as torch's exporter writes it without folding."""
    shape, out = g.shapes[value], g.pick(8, 32)
    weight = g.node("Transpose", [g.weight(out, shape[-1], fan=shape[-1])], (shape[-1], out), perm=[1, 0])
    return g.node("MatMul", [value, weight], (*shape[:-1], out))


def _gemm(g: RandomGraph, value: str) -> str:
    rows, columns = g.shapes[value][-1], g.pick(8, 17, 64)
    turned = g.random.random() < 0.5
    weight = g.weight(*((columns, rows) if turned else (rows, columns)), fan=rows)
    bias = g.pick(None, (columns,), (1, columns), ())
    inputs = [value, weight, *([] if bias is None else [g.constant(g.random.normal(size=bias) / 4)])]
    factors = {"alpha": 0.5, "beta": 2.0} if g.random.random() < 0.15 else {}
    return g.node("Gemm", inputs, (g.shapes[value][0], columns), transB=int(turned), **factors)


def _gemm_of_turned(g: RandomGraph, value: str) -> str:
    """A Gemm that transposes what it reads."""
    shape = g.shapes[value]
    return g.node("Gemm", [value, g.weight(shape[0], 16)], (shape[1], 16), transA=1)


def _twice(g: RandomGraph, value: str) -> str:
    """The same weight in two products, one after the other."""
    width = g.shapes[value][-1]
    weight = g.weight(width, width)
    value = g.node("Tanh", [g.node("MatMul", [value, weight], g.shapes[value])], g.shapes[value])
    return g.node("MatMul", [value, weight], g.shapes[value])


def _both_ways(g: RandomGraph, value: str) -> str:
    """The same weight as it is and transposed, as in a tied autoencoder."""
    shape, width = g.shapes[value], g.shapes[value][-1]
    weight = g.weight(width, g.pick(width, 24))
    other = g.shapes[weight][1]
    value = g.node("Tanh", [g.node("MatMul", [value, weight], (*shape[:-1], other))], (*shape[:-1], other))
    turned = g.node("Transpose", [weight], (other, width), perm=[1, 0])
    return g.node("MatMul", [value, turned], shape)


def _two_heads(g: RandomGraph, value: str) -> str:
    """Two heads with one weight, one of which may be an output of the graph."""
    shape = g.shapes[value]
    weight = g.weight(shape[-1], 16)
    left = g.node("MatMul", [value, weight], (*shape[:-1], 16))
    right = g.node("MatMul", [g.node("Relu", [value], shape), weight], (*shape[:-1], 16))
    if g.random.random() < 0.5:
        g.outputs.append(right)
        return left
    return g.node("Add", [left, right], (*shape[:-1], 16))


def _of_constant(g: RandomGraph, value: str) -> str:
    """A product of two constants, which a query that is learned or zero becomes, added to the rest."""
    shape = g.shapes[value]
    zeros = g.constant(np.zeros((1, 16)) if g.random.random() < 0.5 else g.random.normal(size=(1, 16)))
    made = g.node("MatMul", [zeros, g.weight(16, shape[-1])], (1, shape[-1]))
    return g.node("Add", [value, made], shape)


def _constant_left(g: RandomGraph, value: str) -> str:
    """A product whose first operand is the weight."""
    shape = g.shapes[value]
    return g.node("MatMul", [g.weight(6, shape[-2], fan=shape[-2]), value], (*shape[:-2], 6, shape[-1]))


def _turned_values(g: RandomGraph, value: str) -> str:
    """Activations that are transposed and multiplied with a weight, as in a mixer."""
    shape = g.shapes[value]
    axes = [*range(len(shape) - 2), len(shape) - 1, len(shape) - 2]
    turned = g.node("Transpose", [value], (*shape[:-2], shape[-1], shape[-2]), perm=axes)
    return g.node("MatMul", [turned, g.weight(shape[-2], 16)], (*shape[:-2], shape[-1], 16))


def _of_constant_weight(g: RandomGraph, value: str) -> str:
    """A weight that is computed from constants, as weight normalisation is."""
    rows = g.shapes[value][-1]
    scaled = g.node("Mul", [g.weight(rows, 16), g.constant(np.full((1, 16), 1.5))], (rows, 16))
    return g.node("MatMul", [value, scaled], (*g.shapes[value][:-1], 16))


def _through_identity(g: RandomGraph, value: str) -> str:
    """A weight behind an Identity, as shared modules are exported."""
    rows = g.shapes[value][-1]
    same = g.node("Identity", [g.weight(rows, 16)], (rows, 16))
    return g.node("MatMul", [value, same], (*g.shapes[value][:-1], 16))


def _chosen(g: RandomGraph, value: str) -> str:
    """A branch whose graphs read the value and a weight of the graph around them."""
    shape, weight = g.shapes[value], g.weight(g.shapes[value][-1], 16)
    branches = {}
    for word, kind in (("then_branch", "Relu"), ("else_branch", "Tanh")):
        names = [f"{word}{len(g.nodes)}{letter}" for letter in "ab"]
        nodes = [
            helper.make_node("MatMul", [value, weight], [names[0]], name=names[0]),
            helper.make_node(kind, [names[0]], [names[1]], name=names[1]),
        ]
        out = helper.make_tensor_value_info(names[1], TensorProto.FLOAT, (*shape[:-1], 16))
        branches[word] = helper.make_graph(nodes, word, [], [out])
    axes = g.constant(list(range(len(shape))), np.int64)
    total = g.node("ReduceSum", [value, axes], (), keepdims=0)
    positive = g.node("Greater", [total, g.constant(0.0)], ())
    return g.node("If", [positive], (*shape[:-1], 16), **branches)


def _residual(g: RandomGraph, value: str) -> str:
    width = g.shapes[value][-1]
    made = g.node("MatMul", [g.node("Relu", [value], g.shapes[value]), g.weight(width, width)], g.shapes[value])
    return g.node("Add", [value, made], g.shapes[value])


def _norm(g: RandomGraph, value: str) -> str:
    width = g.shapes[value][-1]
    scale, shift = g.constant(g.random.uniform(0.5, 1.5, width)), g.constant(g.random.normal(size=width) / 4)
    return g.node("LayerNormalization", [value, scale, shift], g.shapes[value], axis=-1)


def _smooth(g: RandomGraph, value: str) -> str:
    return g.node(g.pick("Relu", "Tanh", "Sigmoid"), [value], g.shapes[value])


def _attention(g: RandomGraph, value: str) -> str:
    batch, count, width = g.shapes[value]
    heads, size = g.pick(1, 2, 4), 8
    shape = g.constant([batch, count, heads, size], np.int64)
    found = []
    for axes in ([0, 2, 1, 3], [0, 2, 3, 1], [0, 2, 1, 3]):
        made = g.node("MatMul", [value, g.weight(width, heads * size)], (batch, count, heads * size))
        if g.random.random() < 0.5:
            made = g.node("Add", [made, g.constant(g.random.normal(size=heads * size) / 4)], g.shapes[made])
        split = g.node("Reshape", [made, shape], (batch, count, heads, size))
        sizes = (batch, count, heads, size)
        found.append(g.node("Transpose", [split], tuple(sizes[axis] for axis in axes), perm=axes))
    scores = g.node("MatMul", found[:2], (batch, heads, count, count))
    scores = g.node("Mul", [scores, g.constant(size**-0.5)], g.shapes[scores])
    weights = g.node("Softmax", [scores], g.shapes[scores], axis=-1)
    mixed = g.node("MatMul", [weights, found[2]], (batch, heads, count, size))
    turned = g.node("Transpose", [mixed], (batch, count, heads, size), perm=[0, 2, 1, 3])
    wide = g.node("Reshape", [turned, g.constant([batch, count, heads * size], np.int64)], (batch, count, heads * size))
    made = g.node("MatMul", [wide, g.weight(heads * size, width)], (batch, count, width))
    return g.node("Add", [value, made], g.shapes[value])


def _recurrent(g: RandomGraph, value: str) -> str:
    """A GRU or LSTM over the tokens; the last state or all of them."""
    batch, count, width = g.shapes[value]
    kind, hidden = g.pick("GRU", "LSTM"), g.pick(8, 16)
    gates = {"GRU": 3, "LSTM": 4}[kind] * hidden
    steps = g.node("Transpose", [value], (count, batch, width), perm=[1, 0, 2])
    inputs = [steps, g.weight(1, gates, width, fan=width), g.weight(1, gates, hidden, fan=hidden)]
    if g.random.random() < 0.7:
        inputs.append(g.constant(g.random.normal(size=(1, 2 * gates)) / 4))
    attributes = {"linear_before_reset": 1} if kind == "GRU" else {}
    made = g.node(kind, inputs, (count, 1, batch, hidden), hidden_size=hidden, **attributes)
    one = g.constant([1], np.int64)
    states = g.node("Squeeze", [made, one], (count, batch, hidden))
    return g.node("Transpose", [states], (batch, count, hidden), perm=[1, 0, 2])


def _mean(g: RandomGraph, value: str) -> str:
    batch, count, width = g.shapes[value]
    if count * width > WIDE:
        return _average(g, value)
    return g.node("Reshape", [value, g.constant([batch, count * width], np.int64)], (batch, count * width))


def _convolution(g: RandomGraph, value: str) -> str:
    """A convolution over one, two or three axes, with groups, strides and the normalisation or function after it."""
    batch, channels, *sizes = g.shapes[value]
    axes, size = len(sizes), g.pick(1, 3)
    stride = g.pick(1, 2) if min(sizes) >= 4 else 1
    groups = channels if g.random.random() < 0.2 else 1
    out = channels if groups > 1 else g.pick(8, 12, channels)
    pad = size // 2
    inputs = [value, g.weight(out, channels // groups, *[size] * axes, fan=channels // groups * size**axes)]
    if g.random.random() < 0.6:
        inputs.append(g.constant(g.random.normal(size=out) / 4))
    shape = (batch, out, *((each + 2 * pad - size) // stride + 1 for each in sizes))
    made = g.node("Conv", inputs, shape, kernel_shape=[size] * axes, pads=[pad] * 2 * axes, strides=[stride] * axes,
                  group=groups)  # fmt: skip
    return g.pick(_nothing, _smooth, _batch_norm)(g, made)


def _nothing(_: RandomGraph, value: str) -> str:
    return value


def _batch_norm(g: RandomGraph, value: str) -> str:
    width = g.shapes[value][1]
    numbers = [g.random.uniform(0.5, 1.5, width), g.random.normal(size=width) / 4] * 2
    return g.node("BatchNormalization", [value, *(g.constant(np.abs(each)) for each in numbers)], g.shapes[value])


def _residual_convolution(g: RandomGraph, value: str) -> str:
    """Two convolutions and a 1x1 convolution beside them, as in a residual block."""
    batch, channels, *sizes = g.shapes[value]
    axes, out = len(sizes), g.pick(8, channels)
    shape, attributes = (batch, out, *sizes), {"kernel_shape": [3] * axes, "pads": [1] * 2 * axes}
    made = g.node("Conv", [value, g.weight(out, channels, *[3] * axes, fan=channels * 3**axes)], shape, **attributes)
    made = g.node("Conv", [g.node("Relu", [made], shape), g.weight(out, out, *[3] * axes, fan=out * 3**axes)], shape,
                  **attributes)  # fmt: skip
    beside = g.node("Conv", [value, g.weight(out, channels, *[1] * axes, fan=channels)], shape)
    return g.node("Add", [made, beside], shape)


def _enlarged(g: RandomGraph, value: str) -> str:
    batch, channels, *sizes = g.shapes[value]
    axes = len(sizes)
    if max(sizes) > 16:
        return value
    inputs = [value, g.weight(channels, 8, *[2] * axes, fan=channels), g.constant(g.random.normal(size=8) / 4)]
    return g.node("ConvTranspose", inputs, (batch, 8, *(2 * size for size in sizes)), strides=[2] * axes,
                  kernel_shape=[2] * axes)  # fmt: skip


def _joined(g: RandomGraph, value: str) -> str:
    """Two convolutions, joined over the channels."""
    batch, channels, *sizes = g.shapes[value]
    axes = len(sizes)
    parts = [g.node("Conv", [value, g.weight(4, channels, *[1] * axes, fan=channels)], (batch, 4, *sizes)), value]
    return g.node("Concat", parts, (batch, 4 + channels, *sizes), axis=1)


def _pooled(g: RandomGraph, value: str) -> str:
    batch, channels, *sizes = g.shapes[value]
    if min(sizes) < 4:
        return value
    return g.node("MaxPool", [value], (batch, channels, *(size // 2 for size in sizes)), kernel_shape=[2] * len(sizes),
                  strides=[2] * len(sizes))  # fmt: skip


def _average(g: RandomGraph, value: str) -> str:
    batch, channels, *sizes = g.shapes[value]
    if channels > WIDE:
        return value
    return _flat(g, g.node("GlobalAveragePool", [value], (batch, channels, *[1] * len(sizes))))


def _patches(g: RandomGraph, value: str) -> str:
    """The places of a map as tokens."""
    batch, channels, *sizes = g.shapes[value]
    count = int(np.prod(sizes))
    if count > WIDE:
        return _average(g, value)
    flat = g.node("Reshape", [value, g.constant([batch, channels, count], np.int64)], (batch, channels, count))
    return g.node("Transpose", [flat], (batch, count, channels), perm=[0, 2, 1])


def _flat(g: RandomGraph, value: str) -> str:
    shape = g.shapes[value]
    if len(shape) == 2:
        return value
    if np.prod(shape[1:]) > WIDE:
        return _average(g, value)
    return g.node("Flatten", [value], (shape[0], int(np.prod(shape[1:]))), axis=1)


def _unsqueezed(g: RandomGraph, value: str) -> str:
    return g.node("Unsqueeze", [value, g.constant([0], np.int64)], (1, *g.shapes[value]))


Block = Callable[[RandomGraph, str], str]
PRODUCTS: list[Block] = [
    _linear, _turned, _twice, _both_ways, _two_heads, _of_constant, _constant_left, _turned_values, _of_constant_weight,
    _through_identity, _chosen, _residual, _norm, _smooth,
]  # fmt: skip
MAPS: list[Block] = [_convolution, _convolution, _residual_convolution, _enlarged, _joined, _pooled, _smooth]
BLOCKS: dict[int, list[Block]] = {
    2: [*PRODUCTS, _gemm, _gemm, _gemm_of_turned, _unsqueezed],
    3: [*PRODUCTS, *MAPS, _attention, _attention, _recurrent, _recurrent, _mean],
    4: [*MAPS, _average, _patches],
    5: [*MAPS, _average, _patches],
}
