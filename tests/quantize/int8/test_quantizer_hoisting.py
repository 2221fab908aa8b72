"""Quantizers that are raised: the numbers stay, and what moves is bytes."""

from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.quantize.int8.quantizer_hoisting import hoist_quantizers

RANDOM = np.random.default_rng(0)
FRAME = RANDOM.integers(0, 256, (1, 4, 4, 3)).astype(np.uint8)
STATE = RANDOM.normal(size=(2, 3, 4)).astype(np.float32)
CONSTANTS: dict[str, Any] = {
    "step": np.float32(0.03), "zero": np.uint8(120), "steps": np.full(4, 0.03, np.float32),
    "zeros": np.full(4, 120, np.uint8), "half": np.float32([0.5]), "minus": np.float32(-0.5),
    "row": np.float32([1, 2, 3, 4]), "shape": np.int64([6, 4]), "one": np.float32(1), "level": np.float32(116),
    "at": np.uint8(116), "none": np.uint8(0),
}  # fmt: skip


def node(kind: str, inputs: str, output: str, **attributes: Any) -> Any:
    return helper.make_node(kind, inputs.split(), [output], name=f"make {output}", **attributes)


def quantize(value: str, step: str = "step zero", **attributes: Any) -> list[Any]:
    return [
        node("QuantizeLinear", f"{value} {step}", "q", **attributes),
        node("DequantizeLinear", f"q {step}", "y", **attributes),
    ]


def raised(*nodes: Any, outputs: tuple[str, ...] = ("y",)) -> list[Any]:
    """Raise the quantizers, check that the numbers stay to the last bit, and return the nodes."""
    read = {name for each in nodes for name in each.input}
    graph = helper.make_graph(
        nodes, "main",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, STATE.shape),
         helper.make_tensor_value_info("image", TensorProto.UINT8, FRAME.shape)],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in CONSTANTS.items() if name in read],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    before = run(model)
    hoist_quantizers(model)
    for got, wanted in zip(run(model), before, strict=True):
        np.testing.assert_array_equal(got, wanted)
    return list(model.graph.node)


def run(model: onnx.ModelProto) -> list[np.ndarray]:
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return session.run(None, {"x": STATE, "image": FRAME})


def kinds(nodes: list[Any]) -> list[str]:
    return [each.op_type for each in nodes]


def test_values_are_quantized_before_they_are_moved():
    moves = [node("Transpose", "x", "a", perm=[1, 0, 2]), node("Reshape", "a shape", "b")]
    found = raised(*moves, *quantize("b"))
    assert kinds(found) == ["QuantizeLinear", "Transpose", "Reshape", "DequantizeLinear"]
    assert found[0].input[0] == "x"


@pytest.mark.parametrize("other", ["a reader", "an output"])
def test_what_others_read_as_floats_stays(other):
    moves = [node("Transpose", "x", "a", perm=[1, 0, 2])]
    reader = [node("Neg", "a", "n")] if other == "a reader" else []
    found = raised(*moves, *reader, *quantize("a"), outputs=("y", "n") if reader else ("y", "a"))
    assert kinds(found)[0] == "Transpose"


def test_one_scale_for_each_channel_stays_where_it_is():
    move = node("Transpose", "x", "a", perm=[1, 0, 2])
    found = raised(move, *quantize("a", "steps zeros", axis=2))
    assert kinds(found) == ["Transpose", "QuantizeLinear", "DequantizeLinear"]


@pytest.mark.parametrize(("kind", "operands"), [("Mul", "x half"), ("Mul", "half x"), ("Div", "x half")])
def test_a_positive_scalar_becomes_part_of_the_scale(kind, operands):
    found = raised(node(kind, operands, "a"), *quantize("a"))
    assert kinds(found) == ["QuantizeLinear", "DequantizeLinear"]
    assert found[1].input[1] == "step", "what is given is scaled as before"


@pytest.mark.parametrize(
    ("kind", "operands"), [("Mul", "x minus"), ("Mul", "x row"), ("Div", "half x"), ("Mul", "x x")]
)
def test_any_other_factor_stays(kind, operands):
    assert kinds(raised(node(kind, operands, "a"), *quantize("a")))[0] == kind


def test_what_is_scaled_and_moved_in_turn_is_quantized_first():
    nodes = [
        node("Transpose", "x", "a", perm=[1, 0, 2]), node("Mul", "a half", "b"), node("Reshape", "b shape", "c"),
    ]  # fmt: skip
    found = raised(*nodes, *quantize("c"))
    assert kinds(found) == ["QuantizeLinear", "Transpose", "Reshape", "DequantizeLinear"]


def test_a_scaled_value_that_others_read_is_scaled_for_them():
    found = raised(node("Mul", "x half", "a"), node("Neg", "a", "n"), *quantize("a"), outputs=("y", "n"))
    assert kinds(found) == ["Mul", "Neg", "QuantizeLinear", "DequantizeLinear"]
    assert found[2].input[0] == "x"


def test_a_frame_is_read_as_the_pixels_that_it_is():
    cast = node("Cast", "image", "a", to=TensorProto.FLOAT)
    found = raised(cast, node("Transpose", "a", "b", perm=[0, 3, 1, 2]), *quantize("b", "one none"))
    assert kinds(found) == ["Transpose", "DequantizeLinear"]
    assert found[0].input[0] == "image"


@pytest.mark.parametrize(("zero", "before"), [("at", []), ("zero", ["Cast", "Sub", "QuantizeLinear"])])
def test_a_frame_less_its_zero_point_is_the_pixels_that_it_is(zero, before):
    cast = node("Cast", "image", "a", to=TensorProto.FLOAT)
    found = raised(cast, node("Sub", "a level", "b"), *quantize("b", f"one {zero}"))
    assert kinds(found) == [*before, "DequantizeLinear"]
