"""Small ONNX files as other tools write them, each with the idiom of one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto as T
from onnx import helper as h
from onnx import numpy_helper as nh

N, V = h.make_node, h.make_tensor_value_info
F, D, H, B, L = T.FLOAT, T.DOUBLE, T.FLOAT16, T.BFLOAT16, T.INT64
STATE, ACTION = V("state", F, [1, 16]), V("action", F, [1, 6])
Array = NDArray[Any]


def values(*shape: int, seed: int = 0, scale: float = 0.25) -> Array:
    return (np.random.default_rng(seed + sum(shape)).normal(size=shape) * scale).astype(np.float32)


def weight(name: str, *shape: int, dtype: Any = np.float32) -> Any:
    return nh.from_array(values(*shape, seed=len(name)).astype(dtype), name)


def ints(name: str, *numbers: int, dtype: Any = np.int64) -> Any:
    return nh.from_array(np.array(numbers, dtype), name)


def model(
    nodes: list[Any],
    weights: Iterable[Any] = (),
    inputs: Any = (STATE,),
    outputs: Any = (ACTION,),
    opset: int = 17,
    ir: int = 8,
    domains: tuple[str, ...] = (),
    **more: Any,
) -> Any:
    graph = h.make_graph(nodes, "g", list(inputs), list(outputs), list(weights))
    opsets = [h.make_opsetid("", opset), *(h.make_opsetid(domain, 1) for domain in domains)]
    return h.make_model(graph, opset_imports=opsets, ir_version=ir, **more)


def tf2onnx_constants() -> Any:
    """Weights are Constant nodes, names have slashes, colons and semicolons, a Squeeze of what was a Reshape."""
    held = N("Constant", [], ["policy/dense/MatMul/ReadVariableOp:0"], value=weight("", 16, 32))
    nodes = [
        held,
        N(
            "MatMul",
            ["state", "policy/dense/MatMul/ReadVariableOp:0"],
            ["StatefulPartitionedCall/dense/MatMul:0"],
            "a;b",
        ),
        N("Relu", ["StatefulPartitionedCall/dense/MatMul:0"], ["r:0"], "StatefulPartitionedCall/Relu"),
        N("MatMul", ["r:0", "k:0"], ["action"], "StatefulPartitionedCall/out"),
    ]
    return model(nodes, [weight("k:0", 32, 6)], opset=15)


def keras_nhwc() -> Any:
    """An image with channels last and no batch name, transposed, padded as SAME_UPPER."""
    nodes = [
        N("Transpose", ["image"], ["t"], "transpose", perm=[0, 3, 1, 2]),
        N("Conv", ["t", "W", "b"], ["c"], "conv", auto_pad="SAME_UPPER", strides=[2, 2]),
        N("Relu", ["c"], ["r"], "relu"),
        N("GlobalAveragePool", ["r"], ["p"], "pool"),
        N("Squeeze", ["p", "axes"], ["s"], "squeeze"),
        N("MatMul", ["s", "V"], ["action"], "dense"),
    ]
    image = V("image", F, ["unk__6", 12, 12, 3])
    weights = [weight("W", 8, 3, 3, 3), weight("b", 8), ints("axes", 2, 3), weight("V", 8, 6)]
    return model(nodes, weights, (image,), (V("action", F, ["unk__7", 6]),))


def paddle_scale() -> Any:
    """MatMul with the weight behind a Cast and an Identity, a scale as Mul and Add of constants, opset 11."""
    nodes = [
        N("Constant", [], ["w64"], value=nh.from_array(values(16, 32).astype(np.float64), "")),
        N("Cast", ["w64"], ["w32"], to=F),
        N("Identity", ["w32"], ["w"]),
        N("MatMul", ["state", "w"], ["m"]),
        N("Constant", [], ["two"], value=nh.from_array(np.float32([2]), "")),
        N("Mul", ["m", "two"], ["s"]),
        N("HardSigmoid", ["s"], ["h"], alpha=0.2),
        N("MatMul", ["h", "v"], ["action"]),
    ]
    return model(nodes, [weight("v", 32, 6)], opset=11, ir=6)


def skl2onnx_scaler() -> Any:
    """A Scaler and a LinearRegressor of ai.onnx.ml, whose output has no shape."""
    nodes = [
        N("Scaler", ["state"], ["scaled"], "Sc", domain="ai.onnx.ml", offset=[0.1] * 16, scale=[2.0] * 16),
        N(
            "LinearRegressor",
            ["scaled"],
            ["action"],
            "Li",
            domain="ai.onnx.ml",
            targets=6,
            coefficients=values(96).tolist(),
            intercepts=[0.0] * 6,
        ),
    ]
    state, action = V("state", F, [None, 16]), V("action", F, None)
    return model(nodes, (), (state,), (action,), domains=("ai.onnx.ml",))


def torch_script_gather() -> Any:
    """Shape, Gather, Unsqueeze and Concat before a Reshape, named batch, opset 11 with axes as attributes."""
    nodes = [
        N("Shape", ["state"], ["sh"]),
        N("Gather", ["sh", "zero"], ["n"], axis=0),
        N("Unsqueeze", ["n"], ["nu"], axes=[0]),
        N("Concat", ["nu", "rest"], ["to"], axis=0),
        N("Reshape", ["state", "to"], ["x"]),
        N("Conv", ["x", "W"], ["c"], pads=[1, 1]),
        N("Flatten", ["c"], ["f"]),
        N("Gemm", ["f", "G", "gb"], ["action"], transB=1),
    ]
    weights = [
        nh.from_array(np.array(0), "zero"),
        ints("rest", 2, 8),
        weight("W", 4, 2, 3),
        weight("G", 6, 32),
        weight("gb", 6),
    ]
    return model(nodes, weights, (V("state", F, ["batch", 16]),), (V("action", F, ["batch", 6]),), opset=11, ir=6)


def initializers_as_inputs() -> Any:
    """IR version 3: initializers are listed as inputs, and one that nobody reads is among them."""
    nodes = [N("MatMul", ["state", "W"], ["a"]), N("Add", ["a", "b"], ["action"])]
    weights = [weight("W", 16, 6), weight("b", 6), weight("unread", 99)]
    inputs = (STATE, *(V(tensor.name, F, list(tensor.dims)) for tensor in weights))
    return model(nodes, weights, inputs, opset=9, ir=3)


def domains_and_functions() -> Any:
    """A local function in a domain of its own, and an operator of com.microsoft."""
    inside = [N("MatMul", ["x", "w"], ["m"]), N("Relu", ["m"], ["y"])]
    function = h.make_function("my.lib", "Block", ["x", "w"], ["y"], inside, [h.make_opsetid("", 17)])
    nodes = [
        N("Block", ["state", "W"], ["a"], "block", domain="my.lib"),
        N("FusedMatMul", ["a", "V"], ["f"], "fused", domain="com.microsoft", alpha=0.5),
        N("MatMul", ["f", "U"], ["action"], "out"),
    ]
    weights = [weight("W", 16, 32), weight("V", 32, 32), weight("U", 32, 6)]
    return model(nodes, weights, domains=("my.lib", "com.microsoft"), functions=[function])


def sequence_split() -> Any:
    """SplitToSequence, SequenceAt and ConcatFromSequence between products."""
    nodes = [
        N("MatMul", ["state", "W"], ["a"], "in"),
        N("SplitToSequence", ["a", "sizes"], ["q"], axis=1),
        N("SequenceAt", ["q", "one"], ["second"]),
        N("Relu", ["second"], ["r"]),
        N("SequenceInsert", ["q", "r"], ["longer"]),
        N("ConcatFromSequence", ["longer"], ["c"], axis=1),
        N("MatMul", ["c", "V"], ["action"], "out"),
    ]
    weights = [weight("W", 16, 32), ints("sizes", 16, 16), nh.from_array(np.array(1), "one"), weight("V", 48, 6)]
    return model(nodes, weights)


def identity_chain() -> Any:
    """A weight, an input and an output behind chains of Identity; one weight is shared."""
    nodes = [
        N("Identity", ["W"], ["W1"]),
        N("Identity", ["W1"], ["W2"]),
        N("Transpose", ["W2"], ["W3"], perm=[1, 0]),
        N("Identity", ["state"], ["s1"]),
        N("MatMul", ["s1", "W3"], ["a"]),
        N("MatMul", ["a", "W2"], ["b"]),
        N("MatMul", ["b", "V"], ["c"]),
        N("Identity", ["c"], ["d"]),
        N("Identity", ["d"], ["action"]),
    ]
    return model(nodes, [weight("W", 32, 16), weight("V", 16, 6)])


def already_quantized() -> Any:
    """QDQ around a product, per tensor, as another quantizer writes it."""
    stored = np.clip(np.rint(values(16, 6) / 0.01), -127, 127).astype(np.int8)
    nodes = [
        N("QuantizeLinear", ["state", "s", "z"], ["q"]),
        N("DequantizeLinear", ["q", "s", "z"], ["dq"]),
        N("DequantizeLinear", ["W", "sw", "zw"], ["w"]),
        N("MatMul", ["dq", "w"], ["action"], "a"),
    ]
    scalars = [
        nh.from_array(np.array(value), name)
        for name, value in (("s", np.float32(0.03)), ("z", np.uint8(128)), ("sw", np.float32(0.01)), ("zw", np.int8(0)))
    ]
    return model(nodes, [nh.from_array(stored, "W"), *scalars])


def float16_inside() -> Any:
    """Casts to float16 behind the input and back before the output, everything between in float16."""
    nodes = [
        N("Cast", ["state"], ["h"], to=H),
        N("MatMul", ["h", "W"], ["a"]),
        N("Add", ["a", "b"], ["s"]),
        N("Relu", ["s"], ["r"]),
        N("MatMul", ["r", "V"], ["o"]),
        N("Cast", ["o"], ["action"], to=F),
    ]
    weights = [
        weight("W", 16, 32, dtype=np.float16),
        weight("b", 32, dtype=np.float16),
        weight("V", 32, 6, dtype=np.float16),
    ]
    return model(nodes, weights)


def float16_ends() -> Any:
    """Everything in float16, input and output, too."""
    nodes = [N("MatMul", ["state", "W"], ["a"]), N("Tanh", ["a"], ["t"]), N("MatMul", ["t", "V"], ["action"])]
    weights = [weight("W", 16, 32, dtype=np.float16), weight("V", 32, 6, dtype=np.float16)]
    return model(nodes, weights, (V("state", H, [1, 16]),), (V("action", H, [1, 6]),))


def double_throughout() -> Any:
    """float64 from end to end, as numpy's own type becomes it."""
    nodes = [N("MatMul", ["state", "W"], ["a"]), N("Tanh", ["a"], ["t"]), N("MatMul", ["t", "V"], ["action"])]
    weights = [weight("W", 16, 32, dtype=np.float64), weight("V", 32, 6, dtype=np.float64)]
    return model(nodes, weights, (V("state", D, [1, 16]),), (V("action", D, [1, 6]),))


def bfloat16_inside() -> Any:
    """bfloat16 between two Casts, which ONNX Runtime has no product for."""
    nodes = [
        N("Cast", ["state"], ["h"], to=B),
        N("MatMul", ["h", "W"], ["a"]),
        N("Relu", ["a"], ["r"]),
        N("MatMul", ["r", "V"], ["o"]),
        N("Cast", ["o"], ["action"], to=F),
    ]
    weights = [
        h.make_tensor(name, B, shape, values(*shape).reshape(-1).tolist())
        for name, shape in (("W", (16, 32)), ("V", (32, 6)))
    ]
    return model(nodes, weights)


def empty_optionals() -> Any:
    """Clip without a minimum, Resize without a region of interest, outputs that nobody wants."""
    nodes = [
        N("MatMul", ["state", "W"], ["a"]),
        N("Clip", ["a", "", "six"], ["c"]),
        N("Reshape", ["c", "to"], ["i"]),
        N("Resize", ["i", "", "scales"], ["u"], mode="nearest"),
        N("Flatten", ["u"], ["f"]),
        N("Dropout", ["f", "", ""], ["d", ""]),
        N("MatMul", ["d", "V"], ["action"]),
    ]
    weights = [
        weight("W", 16, 16),
        nh.from_array(np.float32(6), "six"),
        ints("to", 1, 1, 4, 4),
        nh.from_array(np.float32([1, 1, 2, 2]), "scales"),
        weight("V", 64, 6),
    ]
    return model(nodes, weights)


def strange_names() -> Any:
    """Names with spaces, slashes, dots, Greek letters, and one name for all nodes."""
    state = V("robot state/β.0", F, [1, 16])
    nodes = [
        N("MatMul", [state.name, "w 1/ü"], ["µ"], "same"),
        N("Relu", ["µ"], ["r"], "same"),
        N("MatMul", ["r", "v"], ["the action"], "same"),
    ]
    return model(nodes, [weight("w 1/ü", 16, 32), weight("v", 32, 6)], (state,), (V("the action", F, [1, 6]),))


def loop_of_products() -> Any:
    """A Loop of five turns over a product, as a flow's steps are unrolled into."""
    body = h.make_graph(
        [
            N("MatMul", ["x_in", "W"], ["m"], "step"),
            N("Tanh", ["m"], ["x_out"]),
            N("Identity", ["cond_in"], ["cond_out"]),
        ],
        "body",
        [V("i", L, []), V("cond_in", T.BOOL, []), V("x_in", F, [1, 16])],
        [V("cond_out", T.BOOL, []), V("x_out", F, [1, 16])],
    )
    nodes = [N("Loop", ["trips", "", "state"], ["x"], "loop", body=body), N("MatMul", ["x", "V"], ["action"], "out")]
    return model(nodes, [ints("trips", 5), weight("W", 16, 16), weight("V", 16, 6)])


def loop_until() -> Any:
    """A Loop that ends when a value says so: nobody knows how many turns before it runs."""
    body = h.make_graph(
        [N("MatMul", ["x_in", "W"], ["x_out"], "step"), N("Less", ["i", "two"], ["cond_out"])],
        "body",
        [V("i", L, []), V("cond_in", T.BOOL, []), V("x_in", F, None)],
        [V("cond_out", T.BOOL, []), V("x_out", F, None)],
    )
    nodes = [N("Loop", ["", "yes", "state"], ["x"], "loop", body=body), N("MatMul", ["x", "V"], ["action"], "out")]
    return model(
        nodes,
        [
            nh.from_array(np.array(True), "yes"),
            nh.from_array(np.array(2), "two"),
            weight("W", 16, 16),
            weight("V", 16, 6),
        ],
    )


def scan_of_products() -> Any:
    """A Scan over four frames."""
    body = h.make_graph(
        [N("MatMul", ["x", "W"], ["m"], "frame"), N("Add", ["m", "s"], ["t"]), N("Identity", ["t"], ["each"])],
        "body",
        [V("s", F, [1, 16]), V("x", F, [1, 16])],
        [V("t", F, [1, 16]), V("each", F, [1, 16])],
    )
    nodes = [
        N("Reshape", ["frames", "to"], ["f"]),
        N("Scan", ["zeros", "f"], ["last", "all"], "scan", body=body, num_scan_inputs=1),
        N("MatMul", ["last", "V"], ["action"], "out"),
    ]
    weights = [
        ints("to", 4, 1, 16),
        nh.from_array(np.zeros((1, 16), np.float32), "zeros"),
        weight("W", 16, 16),
        weight("V", 16, 6),
    ]
    return model(nodes, weights, (V("frames", F, [1, 4, 16]),))


def branches_of_products() -> Any:
    """An If with a small product in one branch and two in the other, one name for both outputs."""
    near = h.make_graph([N("MatMul", ["x", "Wn"], ["y"], "p")], "near", [], [V("y", F, [1, 6])])
    far = h.make_graph(
        [N("MatMul", ["x", "Wf"], ["h"], "p"), N("MatMul", ["h", "Wg"], ["y"], "q")], "far", [], [V("y", F, [1, 6])]
    )
    nodes = [
        N("MatMul", ["state", "W0"], ["x"], "enc"),
        N("ReduceMax", ["x"], ["m"], keepdims=0),
        N("Greater", ["m", "z"], ["c"]),
        N("If", ["c"], ["action"], "choose", then_branch=near, else_branch=far),
    ]
    weights = [
        weight("W0", 16, 64),
        weight("Wn", 64, 6),
        weight("Wf", 64, 32),
        weight("Wg", 32, 6),
        nh.from_array(np.float32(0.5), "z"),
    ]
    return model(nodes, weights)


def narrow_inputs() -> Any:
    """int8 and uint16 sensors, cast to float inside."""
    nodes = [
        N("Cast", ["state"], ["s"], to=F),
        N("Cast", ["depth"], ["d"], to=F),
        N("Mul", ["d", "mm"], ["metres"]),
        N("Concat", ["s", "metres"], ["x"], axis=1),
        N("MatMul", ["x", "W"], ["action"], "out"),
    ]
    inputs = (V("state", T.INT8, [1, 16]), V("depth", T.UINT16, [1, 8]))
    return model(nodes, [nh.from_array(np.float32(0.001), "mm"), weight("W", 24, 6)], inputs)


def scalar_ends() -> Any:
    """A rate without axes as an input, and a value without axes as a second output."""
    nodes = [
        N("Mul", ["state", "rate"], ["s"]),
        N("MatMul", ["s", "W"], ["action"], "out"),
        N("ReduceMean", ["action"], ["value"], keepdims=0),
    ]
    return model(nodes, [weight("W", 16, 6)], (STATE, V("rate", F, [])), (ACTION, V("value", F, [])))


def upsampled() -> Any:
    """Opset 7, as the first exporters of torch wrote it: Upsample with an attribute, Dropout, weights as inputs."""
    nodes = [
        N("Reshape", ["state", "s"], ["a"]),
        N("Upsample", ["a"], ["b"], scales=[1.0, 1.0, 2.0, 2.0], mode="nearest"),
        N("Conv", ["b", "W"], ["c"], kernel_shape=[3, 3]),
        N("Dropout", ["c"], ["d"], ratio=0.5),
        N("GlobalAveragePool", ["d"], ["e"]),
        N("Flatten", ["e"], ["action"]),
    ]
    inputs = (STATE, V("s", L, [4]), V("W", F, [6, 1, 3, 3]))
    return model(nodes, [ints("s", 1, 1, 4, 4), weight("W", 6, 1, 3, 3)], inputs, opset=7, ir=3)


def integer_products() -> Any:
    """What a dynamic quantizer left behind: DynamicQuantizeLinear and MatMulInteger beside a float32 product."""
    nodes = [
        N("DynamicQuantizeLinear", ["state"], ["q", "qs", "qz"]),
        N("MatMulInteger", ["q", "W", "qz"], ["i"]),
        N("Cast", ["i"], ["f"], to=F),
        N("Mul", ["qs", "ws"], ["s"]),
        N("Mul", ["f", "s"], ["h"]),
        N("Relu", ["h"], ["r"]),
        N("MatMul", ["r", "W2"], ["action"]),
    ]
    codes = np.random.default_rng(0).integers(-100, 100, (16, 32)).astype(np.int8)
    scale = np.array(0.01, np.float32)
    return model(nodes, [nh.from_array(codes, "W"), nh.from_array(scale, "ws"), weight("W2", 32, 6)])


def einsum_heads() -> Any:
    """Attention of two heads in Einsum."""
    nodes = [
        N("Reshape", ["state", "s"], ["x"]),
        N("Einsum", ["x", "Wq"], ["q"], equation="btc,chd->bthd"),
        N("Einsum", ["x", "Wk"], ["k"], equation="btc,chd->bthd"),
        N("Einsum", ["q", "k"], ["scores"], equation="bthd,bshd->bhts"),
        N("Softmax", ["scores"], ["p"], axis=-1),
        N("Einsum", ["p", "q"], ["o"], equation="bhts,bshd->bthd"),
        N("ReduceMean", ["o"], ["m"], axes=[1], keepdims=0),
        N("Flatten", ["m"], ["f"]),
        N("MatMul", ["f", "Wo"], ["action"]),
    ]
    return model(nodes, [ints("s", 1, 4, 4), weight("Wq", 4, 2, 4), weight("Wk", 4, 2, 4), weight("Wo", 8, 6)])


def best_of_many() -> Any:
    """TopK whose indices choose rows of a table."""
    nodes = [
        N("MatMul", ["state", "W"], ["h"]),
        N("TopK", ["h", "k"], ["v", "i"], axis=-1),
        N("Gather", ["E", "i"], ["g"]),
        N("Unsqueeze", ["v", "two"], ["vu"]),
        N("Mul", ["g", "vu"], ["gm"]),
        N("ReduceSum", ["gm", "one"], ["m"], keepdims=0),
        N("MatMul", ["m", "Wo"], ["action"]),
    ]
    weights = [
        weight("W", 16, 32),
        ints("k", 4),
        weight("E", 32, 8),
        ints("two", 2),
        ints("one", 1),
        weight("Wo", 8, 6),
    ]
    return model(nodes, weights)


def one_hot() -> Any:
    """ArgMax, OneHot, and Where over what a product gives."""
    nodes = [
        N("MatMul", ["state", "W"], ["h"]),
        N("ArgMax", ["h"], ["i"], axis=-1, keepdims=0),
        N("OneHot", ["i", "depth", "v"], ["o"]),
        N("MatMul", ["o", "W2"], ["p"]),
        N("Greater", ["p", "z"], ["c"]),
        N("Where", ["c", "p", "z"], ["action"]),
    ]
    ends, zero = np.array([0, 1], np.float32), np.array(0, np.float32)
    constants = [nh.from_array(np.array(8), "depth"), nh.from_array(ends, "v"), nh.from_array(zero, "z")]
    return model(nodes, [weight("W", 16, 8), weight("W2", 8, 6), *constants])


def lstm_both_ways() -> Any:
    """A bidirectional LSTM with lengths and first states, as keras2onnx writes it."""
    nodes = [
        N("Reshape", ["state", "s"], ["x"]),
        N(
            "LSTM",
            ["x", "W", "R", "B", "length", "h0", "c0"],
            ["y", "yh", "yc"],
            hidden_size=8,
            direction="bidirectional",
        ),
        N("Transpose", ["yh"], ["t"], perm=[1, 0, 2]),
        N("Reshape", ["t", "flat"], ["f"]),
        N("Gemm", ["f", "Wo", "bo"], ["action"], transB=1),
    ]
    first = [ints("s", 4, 1, 4), ints("length", 3, dtype=np.int32), ints("flat", 1, 16)]
    weights = [
        weight("W", 2, 32, 4),
        weight("R", 2, 32, 8),
        weight("B", 2, 64),
        weight("h0", 2, 1, 8),
        weight("c0", 2, 1, 8),
    ]
    return model(nodes, [*first, *weights, weight("Wo", 6, 16), weight("bo", 6)])


def sums_and_scatter() -> Any:
    """CumSum, and ScatterND that clears two places."""
    nodes = [
        N("MatMul", ["state", "W"], ["h"]),
        N("CumSum", ["h", "axis"], ["c"]),
        N("ScatterND", ["c", "places", "zeros"], ["s"]),
        N("MatMul", ["s", "Wo"], ["action"]),
    ]
    places = nh.from_array(np.array([[0, 2], [0, 5]]), "places")
    axis, zeros = ints("axis", 1, dtype=np.int32), nh.from_array(np.zeros(2, np.float32), "zeros")
    return model(nodes, [weight("W", 16, 8), axis, places, zeros, weight("Wo", 8, 6)])


def count_of_positive() -> Any:
    """NonZero: a shape that depends on values."""
    nodes = [
        N("Greater", ["state", "z"], ["c"]),
        N("NonZero", ["c"], ["nz"]),
        N("Shape", ["nz"], ["sh"]),
        N("Cast", ["sh"], ["f"], to=F),
        N("Reshape", ["f", "s"], ["row"]),
        N("MatMul", ["row", "W"], ["b"]),
        N("MatMul", ["state", "W2"], ["a"]),
        N("Add", ["a", "b"], ["action"]),
    ]
    zero = nh.from_array(np.array(0, np.float32), "z")
    return model(nodes, [zero, ints("s", 1, 2), weight("W", 2, 6), weight("W2", 16, 6)])


def sparse_weight() -> Any:
    """A weight as sparse tensor, with one index for each value; another one in a Constant, with one for each axis."""

    def sparse(name: str, places: Any) -> Any:
        held = nh.from_array(np.array([1, -2, 3], np.float32), name)
        return h.make_sparse_tensor(held, nh.from_array(np.array(places), f"{name}.places"), [16, 6])

    nodes = [
        N("Constant", [], ["V"], sparse_value=sparse("v", [[0, 1], [3, 3], [15, 5]])),
        N("MatMul", ["state", "W"], ["a"]),
        N("MatMul", ["state", "V"], ["b"]),
        N("MatMul", ["state", "W2"], ["c"]),
        N("Sum", ["a", "b", "c"], ["action"]),
    ]
    made = model(nodes, [weight("W2", 16, 6)])
    made.graph.sparse_initializer.append(sparse("W", [0, 7, 50]))
    return made


def symbolic_batch() -> Any:
    """A batch axis with a name, read by Shape and put together again by Concat."""
    nodes = [
        N("Shape", ["state"], ["sh"]),
        N("Gather", ["sh", "z"], ["b"]),
        N("Concat", ["b", "rest"], ["to"], axis=0),
        N("Reshape", ["state", "to"], ["x"]),
        N("MatMul", ["x", "W"], ["h"]),
        N("ReduceMax", ["h"], ["action"], axes=[1], keepdims=0),
    ]
    inputs, outputs = (V("state", F, ["batch", 16]),), (V("action", F, ["batch", 6]),)
    return model(nodes, [ints("z", 0), ints("rest", 4, 4), weight("W", 4, 6)], inputs, outputs)


def chosen_action() -> Any:
    """A discrete policy that gives the number of its action."""
    nodes = [N("MatMul", ["state", "W"], ["h"]), N("ArgMax", ["h"], ["action"], axis=-1, keepdims=0)]
    return model(nodes, [weight("W", 16, 6)], outputs=(V("action", L, [1]),))


def camera_bytes() -> Any:
    """A uint8 image, channels last; SAME_LOWER, ceil_mode, HardSwish, and a Gemm with a factor."""
    nodes = [
        N("Cast", ["image"], ["f"], to=F),
        N("Mul", ["f", "k"], ["x"]),
        N("Transpose", ["x"], ["t"], perm=[0, 3, 1, 2]),
        N("Conv", ["t", "W"], ["c"], kernel_shape=[5, 5], strides=[2, 2], auto_pad="SAME_LOWER"),
        N("HardSwish", ["c"], ["hs"]),
        N("AveragePool", ["hs"], ["p"], kernel_shape=[3, 3], ceil_mode=1, strides=[2, 2], count_include_pad=1),
        N("Flatten", ["p"], ["fl"]),
        N("Gemm", ["fl", "Wo"], ["action"], alpha=0.5),
    ]
    scale = nh.from_array(np.array(1 / 255, np.float32), "k")
    return model(nodes, [scale, weight("W", 8, 3, 5, 5), weight("Wo", 128, 6)], (V("image", T.UINT8, [1, 16, 16, 3]),))


def idle_ends() -> Any:
    """An input that nothing reads, an output that is a weight, and one that is an input renamed."""
    nodes = [N("MatMul", ["state", "W"], ["action"]), N("Identity", ["state"], ["debug"])]
    outputs = (ACTION, V("debug", F, [1, 16]), V("version", F, [1, 1]))
    return model(nodes, [weight("W", 16, 6), weight("version", 1, 1)], (STATE, V("extra", F, [1, 3])), outputs)


def sizes_computed() -> Any:
    """Resize to sizes that Shape, Slice, Mul and Concat compute."""
    nodes = [
        N("Reshape", ["state", "s"], ["x"]),
        N("Shape", ["x"], ["sh"]),
        N("Slice", ["sh", "a", "b"], ["hw"]),
        N("Mul", ["hw", "twice"], ["hw2"]),
        N("Slice", ["sh", "z", "a"], ["nc"]),
        N("Concat", ["nc", "hw2"], ["sizes"], axis=0),
        N("Resize", ["x", "", "", "sizes"], ["r"], mode="linear", coordinate_transformation_mode="align_corners"),
        N("Conv", ["r", "W"], ["c"], kernel_shape=[3, 3]),
        N("GlobalMaxPool", ["c"], ["g"]),
        N("Flatten", ["g"], ["action"]),
    ]
    numbers = [ints("s", 1, 1, 4, 4), ints("a", 2), ints("b", 4), ints("z", 0), ints("twice", 2, 2)]
    return model(nodes, [*numbers, weight("W", 6, 1, 3, 3)])


KINDS: dict[str, Callable[[], Any]] = {
    made.__name__: made
    for made in (
        tf2onnx_constants,
        keras_nhwc,
        paddle_scale,
        skl2onnx_scaler,
        torch_script_gather,
        initializers_as_inputs,
        domains_and_functions,
        sequence_split,
        identity_chain,
        already_quantized,
        float16_inside,
        float16_ends,
        double_throughout,
        bfloat16_inside,
        empty_optionals,
        strange_names,
        loop_of_products,
        loop_until,
        scan_of_products,
        branches_of_products,
        narrow_inputs,
        scalar_ends,
        upsampled,
        integer_products,
        einsum_heads,
        best_of_many,
        one_hot,
        lstm_both_ways,
        sums_and_scatter,
        count_of_positive,
        sparse_weight,
        symbolic_batch,
        chosen_action,
        camera_bytes,
        idle_ends,
        sizes_computed,
    )
}
"""Idiom -> the file."""


def write(name: str, folder: Path) -> Path:
    """Write the file of an idiom; return its path."""
    path = folder / f"{name}.onnx"
    onnx.save(KINDS[name](), path)
    return path
