from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.quantize.int8.integer_matmul import use_integer_matmul
from vlatool.runtime.arithmetic import PRECISE_OPTION

RANDOM = np.random.default_rng(0)
WEIGHT = RANDOM.integers(-127, 128, (4, 3)).astype(np.int8)
CONSTANTS = {
    "x_scale": np.float32(0.02),
    "x_zero": np.uint8(120),
    "w": WEIGHT,
    "w_scale": np.float32([0.01, 0.02, 0.005]),
    "w_zero": np.zeros(3, np.int8),
    "bias": np.float32([1, -2, 3]),
}
QUANTIZE = [
    helper.make_node("QuantizeLinear", ["x", "x_scale", "x_zero"], ["xq"], "quantize"),
    helper.make_node("DequantizeLinear", ["xq", "x_scale", "x_zero"], ["xd"], "dequantize"),
    helper.make_node("DequantizeLinear", ["w", "w_scale", "w_zero"], ["wd"], "weight", axis=1),
]
PRODUCT = helper.make_node("MatMul", ["xd", "wd"], ["product"], "product")


def model(*nodes: Any, outputs: tuple[str, ...] = ("y",), **constants: Any) -> onnx.ModelProto:
    """A model of ``x`` (1, 4) and the nodes; every constant that a node reads is an initializer."""
    known = {**CONSTANTS, **constants}
    read = {name for node in nodes for name in node.input}
    graph = helper.make_graph(
        nodes,
        "main",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, 4))],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in known.items() if name in read],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)


def run(made: onnx.ModelProto) -> list[np.ndarray]:
    session = onnxruntime.InferenceSession(made.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"x": np.linspace(-2, 2, 4, dtype=np.float32)[None]})


def rewritten(made: onnx.ModelProto, count: int) -> list[str]:
    """Rewrite, check that the numbers stay, and return the operators."""
    before = run(made)
    assert use_integer_matmul(made) == count
    for got, wanted in zip(run(made), before, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-5)
    return [node.op_type for node in made.graph.node]


@pytest.mark.parametrize("operands", [["product", "bias"], ["bias", "product"]])
def test_a_product_with_bias_becomes_one_node(operands):
    made = model(*QUANTIZE, PRODUCT, helper.make_node("Add", operands, ["y"]))
    assert rewritten(made, 1) == ["QuantizeLinear", "MatMulIntegerToFloat"]
    fused = made.graph.node[1]
    assert list(fused.input) == ["xq", "w", "x_scale", "w_scale", "x_zero", "w_zero", "bias"]
    assert (fused.domain, fused.name, list(fused.output)) == ("com.microsoft", "product", ["y"])
    assert {tensor.name for tensor in made.graph.initializer} == set(CONSTANTS)


def test_a_product_without_bias_becomes_one_node():
    made = model(*QUANTIZE, helper.make_node("MatMul", ["xd", "wd"], ["y"]))
    assert rewritten(made, 1) == ["QuantizeLinear", "MatMulIntegerToFloat"]
    assert len(made.graph.node[1].input) == 6


@pytest.mark.parametrize("rank", [2, 4])
def test_a_product_of_two_activations_becomes_one_node(rank):
    shape = helper.make_node("Reshape", ["x", "shape"], ["s"])
    turn = helper.make_node("Transpose", ["s"], ["st"], perm=[*range(rank - 2), rank - 1, rank - 2])
    pairs = [
        helper.make_node(kind, [first, "x_scale", "x_zero"], [to])
        for value in ("s", "st")
        for kind, first, to in (("QuantizeLinear", value, f"{value}q"), ("DequantizeLinear", f"{value}q", f"{value}d"))
    ]
    product = helper.make_node("MatMul", ["sd", "std"], ["product"], "product")
    sizes = np.int64([1] * (rank - 2) + [2, 2])
    made = model(shape, turn, *pairs, product, helper.make_node("Add", ["product", "bias"], ["y"]), shape=sizes,
                 bias=np.float32([1, 2]))  # fmt: skip
    assert rewritten(made, 1)[-2:] == ["MatMulIntegerToFloat", "Add"]
    assert list(made.graph.node[-2].input) == ["sq", "stq", "x_scale", "x_scale", "x_zero", "x_zero"]


def test_two_activations_with_a_scale_for_each_channel_stay():
    turn = helper.make_node("Transpose", ["x"], ["t"])
    pairs = [
        helper.make_node("QuantizeLinear", ["t", "scales", "zeros"], ["tq"], axis=0),
        helper.make_node("DequantizeLinear", ["tq", "scales", "zeros"], ["td"], axis=0),
    ]
    made = model(*QUANTIZE[:2], turn, *pairs, helper.make_node("MatMul", ["xd", "td"], ["y"]),
                 scales=np.float32([0.1, 0.2, 0.3, 0.4]), zeros=np.full(4, 9, np.uint8))  # fmt: skip
    assert use_integer_matmul(made) == 0


def test_two_products_share_the_quantized_input():
    other = [
        helper.make_node("DequantizeLinear", ["v", "w_scale", "w_zero"], ["vd"], axis=1),
        helper.make_node("MatMul", ["xd", "vd"], ["z"]),
    ]
    made = model(
        *QUANTIZE,
        PRODUCT,
        helper.make_node("Add", ["product", "bias"], ["y"]),
        *other,
        outputs=("y", "z"),
        v=WEIGHT[::-1],
    )
    assert rewritten(made, 2) == ["QuantizeLinear", "MatMulIntegerToFloat", "MatMulIntegerToFloat"]


def test_two_products_of_one_weight_have_one_each_and_are_exact_where_products_saturate():
    again = helper.make_node("MatMul", ["xd", "wd"], ["second"], "again")
    made = model(*QUANTIZE, PRODUCT, again, outputs=("product", "second"))
    wanted = run(made)
    assert use_integer_matmul(made) == 2
    first, second = (node for node in made.graph.node if node.op_type == "MatMulIntegerToFloat")
    assert first.input[1] != second.input[1]
    assert first.input[5] != second.input[5]
    for got, value in zip(run(made), wanted, strict=True):
        np.testing.assert_allclose(got, value, atol=1e-6)
    options = onnxruntime.SessionOptions()
    options.add_session_config_entry(*PRECISE_OPTION)
    onnxruntime.InferenceSession(made.SerializeToString(), options, providers=["CPUExecutionProvider"])


def test_a_dequantized_input_that_somebody_else_reads_is_kept():
    made = model(
        *QUANTIZE,
        PRODUCT,
        helper.make_node("Add", ["product", "bias"], ["y"]),
        helper.make_node("Relu", ["xd"], ["z"]),
        outputs=("y", "z"),
    )
    kinds = rewritten(made, 1)
    assert sorted(kinds) == ["DequantizeLinear", "MatMulIntegerToFloat", "QuantizeLinear", "Relu"]


def test_a_product_that_is_also_an_output_keeps_its_add():
    made = model(*QUANTIZE, PRODUCT, helper.make_node("Add", ["product", "bias"], ["y"]), outputs=("y", "product"))
    assert rewritten(made, 1) == ["QuantizeLinear", "MatMulIntegerToFloat", "Add"]


def test_a_product_that_is_read_twice_keeps_its_add():
    made = model(
        *QUANTIZE,
        PRODUCT,
        helper.make_node("Add", ["product", "bias"], ["y"]),
        helper.make_node("Relu", ["product"], ["z"]),
        outputs=("y", "z"),
    )
    assert rewritten(made, 1) == ["QuantizeLinear", "MatMulIntegerToFloat", "Add", "Relu"]


@pytest.mark.parametrize(
    "bias", [np.float32(5), np.float32([[1, 2, 3]]), np.float32([7])], ids=["scalar", "2-d", "one"]
)
def test_an_add_that_is_no_bias_of_the_columns_stays(bias):
    made = model(*QUANTIZE, PRODUCT, helper.make_node("Add", ["product", "bias"], ["y"]), bias=bias)
    assert rewritten(made, 1) == ["QuantizeLinear", "MatMulIntegerToFloat", "Add"]


def test_an_add_of_two_activations_stays():
    made = model(*QUANTIZE, PRODUCT, helper.make_node("Add", ["product", "product"], ["y"]))
    assert "Add" in rewritten(made, 1)


def test_a_product_of_two_activations_is_left_alone():
    nodes = [
        *QUANTIZE[:2],
        helper.make_node("Transpose", ["xd"], ["xt"], perm=[1, 0]),
        helper.make_node("MatMul", ["xd", "xt"], ["y"]),
    ]
    before = [node.op_type for node in nodes]
    assert rewritten(model(*nodes), 0) == before


def test_a_float_product_is_left_alone():
    made = model(helper.make_node("MatMul", ["x", "f"], ["y"]), f=np.ones((4, 2), np.float32))
    assert rewritten(made, 0) == ["MatMul"]
    assert [entry.domain for entry in made.opset_import] == [""]


def test_a_weight_of_three_axes_is_left_alone():
    nodes = [
        *QUANTIZE[:2],
        helper.make_node("DequantizeLinear", ["v", "v_scale", "v_zero"], ["vd"]),
        helper.make_node("MatMul", ["xd", "vd"], ["y"]),
    ]
    made = model(*nodes, v=WEIGHT[None], v_scale=np.float32(0.1), v_zero=np.int8(0))
    assert "MatMul" in rewritten(made, 0)


def test_a_dequantizer_without_zero_point_is_left_alone():
    nodes = [*QUANTIZE[:2], helper.make_node("DequantizeLinear", ["w", "w_scale"], ["wd"], axis=1)]
    made = model(*nodes, helper.make_node("MatMul", ["xd", "wd"], ["y"]))
    assert "MatMul" in rewritten(made, 0)


def test_an_opset_that_is_declared_already_is_not_declared_twice(tmp_path: Path):
    made = model(*QUANTIZE, helper.make_node("MatMul", ["xd", "wd"], ["y"]))
    made.opset_import.append(helper.make_opsetid("com.microsoft", 1))
    rewritten(made, 1)
    assert sorted(entry.domain for entry in made.opset_import) == ["", "com.microsoft"]
    onnx.save(made, tmp_path / "a.onnx")
