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
    )
}
"""Idiom -> the file."""


def write(name: str, folder: Path) -> Path:
    """Write the file of an idiom; return its path."""
    path = folder / f"{name}.onnx"
    onnx.save(KINDS[name](), path)
    return path
