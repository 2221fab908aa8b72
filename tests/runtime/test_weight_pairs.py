"""Which graphs need no exact mode is read from their bytes, and never believed of a graph that does."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError
from vlatool.runtime.external_data import SEARCH_BYTES
from vlatool.runtime.weight_pairs import weights_fit

FITS, SATURATES = np.full((4, 2), 60, np.int8), np.full((4, 2), 100, np.int8)


def model_of(*nodes: onnx.NodeProto, **weights: np.ndarray) -> bytes:
    tensors = [numpy_helper.from_array(values, name) for name, values in weights.items()]
    graph = helper.make_graph(list(nodes), "main", [], [], tensors)
    content: bytes = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)]).SerializeToString()
    return content


def product(kind: str, weight: str = "w", **options: int) -> onnx.NodeProto:
    first = ["x", "sx", "zx"] if kind in ("QLinearMatMul", "QLinearConv", "QGemm") else ["x"]
    return helper.make_node(kind, [*first, weight], [f"{weight}.y"], **options)


@pytest.mark.parametrize("kind", ["MatMul", "MatMulInteger", "MatMulIntegerToFloat", "DynamicQuantizeMatMul",
                                  "QLinearMatMul", "Gemm", "QGemm"])  # fmt: skip
def test_weights_of_products_are_held_against_their_sums(kind: str) -> None:
    assert weights_fit(model_of(product(kind), w=FITS))
    assert not weights_fit(model_of(product(kind), w=SATURATES))


@pytest.mark.parametrize("kind", ["Conv", "QLinearConv"])
def test_weights_of_convolutions_are_held_against_their_sums(kind: str) -> None:
    assert weights_fit(model_of(product(kind), w=np.full((2, 4, 1, 1), 60, np.int8)))
    assert not weights_fit(model_of(product(kind), w=np.full((2, 4, 1, 1), 100, np.int8)))


def test_dequantized_weights_are_followed_to_their_product() -> None:
    pair = helper.make_node("DequantizeLinear", ["w", "s"], ["d"])
    assert weights_fit(model_of(pair, product("MatMul", "d"), w=FITS))
    assert not weights_fit(model_of(pair, product("MatMul", "d"), w=SATURATES))


def test_the_axis_along_which_products_add_up_is_the_one_that_counts() -> None:
    along_the_first = np.array([[100, 0], [100, 0]], np.int8)
    assert not weights_fit(model_of(product("Gemm"), w=along_the_first))
    assert weights_fit(model_of(product("Gemm", transB=1), w=along_the_first))
    assert not weights_fit(model_of(product("Gemm", transB=1), w=along_the_first.T.copy()))


@pytest.mark.parametrize("nodes", [
    [],
    [helper.make_node("Relu", ["w"], ["y"])],
    [product("MatMul"), helper.make_node("LSTM", ["x", "w", "r"], ["z"])],
    [helper.make_node("MatMul", ["w", "x"], ["y"])],
    [helper.make_node("Transpose", ["w"], ["t"]), product("MatMul", "t")],
], ids=["none", "another operator", "a second reader", "the first operand", "transposed"])  # fmt: skip
def test_a_weight_whose_readers_are_not_known_may_saturate(nodes: list[onnx.NodeProto]) -> None:
    assert not weights_fit(model_of(*nodes, w=FITS))


def test_a_table_that_is_looked_up_is_multiplied_by_nothing() -> None:
    gather = helper.make_node("Gather", ["table", "ids"], ["y"])
    assert weights_fit(model_of(gather, product("MatMul"), w=FITS, table=SATURATES))


def test_one_weight_that_saturates_is_enough() -> None:
    nodes = product("MatMul"), product("MatMul", "v")
    assert weights_fit(model_of(*nodes, w=FITS, v=FITS))
    assert not weights_fit(model_of(*nodes, w=FITS, v=SATURATES))


def test_weights_within_a_branch_count() -> None:
    branch = helper.make_graph([product("MatMul")], "b", [], [], [numpy_helper.from_array(SATURATES, "w")])
    whole = helper.make_node("If", ["flag"], ["c"], then_branch=branch, else_branch=branch)
    assert not weights_fit(model_of(whole, product("MatMul", "v"), v=FITS))


def test_two_weights_of_one_name_are_not_told_apart() -> None:
    branch = helper.make_graph([product("MatMul")], "b", [], [], [numpy_helper.from_array(FITS, "w")])
    assert not weights_fit(
        model_of(helper.make_node("If", ["f"], ["c"], then_branch=branch), product("MatMul"), w=FITS)
    )


def test_a_graph_without_int8_weights_has_none_that_fit() -> None:
    assert not weights_fit(b"")
    assert not weights_fit(model_of(product("MatMul"), w=FITS.astype(np.float32)))


def test_weights_that_are_not_in_the_file_may_saturate() -> None:
    outside = TensorProto(name="w", data_type=TensorProto.INT8, dims=[4, 2], data_location=TensorProto.EXTERNAL)
    graph = helper.make_graph([product("MatMul")], "main", [], [], [outside])
    assert not weights_fit(helper.make_model(graph).SerializeToString())


def test_a_large_file_is_read_like_its_bytes(tmp_path: Path) -> None:
    for values, right in (
        (np.full((SEARCH_BYTES, 3), 60, np.int8), True),
        (np.full((SEARCH_BYTES, 3), -100, np.int8), False),
    ):
        content = model_of(product("MatMul"), w=values)
        (tmp_path / "model.onnx").write_bytes(content)
        assert weights_fit(content) is right
        assert weights_fit(tmp_path / "model.onnx") is right


def test_what_is_no_graph_is_an_error() -> None:
    with pytest.raises(GraphError, match="not an ONNX model"):
        weights_fit(b"\x3a\xff\xff\xff\xff\x0f")


def test_a_quantized_bundle_fits_when_it_was_asked_to(
    int8_bundle: Bundle, float_bundle: Bundle, tmp_path: Path
) -> None:
    from vlatool.quantize.dynamic_int8 import DynamicInt8
    from vlatool.quantize.static_int8 import StaticInt8
    from vlatool.stage.base import Context

    stages = [StaticInt8(reduce_range=True), StaticInt8(reduce_range=True, layout="qdq"),
              StaticInt8(reduce_range=True, per_channel=False), DynamicInt8(reduce_range=True),
              DynamicInt8(reduce_range=True, per_channel=False)]  # fmt: skip
    for number, stage in enumerate(stages):
        (tmp_path / str(number)).mkdir()
        made = stage.run(float_bundle, tmp_path / str(number), Context()).bundle
        assert weights_fit(made.path / "graphs/main.onnx"), stage
    assert not weights_fit(int8_bundle.path / "graphs/main.onnx")


def test_a_vector_is_a_zero_point_unless_it_is_multiplied() -> None:
    zeros = helper.make_node("MatMulInteger", ["x", "w", "", "zeros"], ["y"])
    assert weights_fit(model_of(zeros, w=FITS, zeros=np.zeros(2, np.int8)))
    assert not weights_fit(
        model_of(product("MatMul"), product("MatMulInteger", "v"), w=FITS, v=np.full(4, 100, np.int8))
    )


def quantizer(name: str, out: str, zero: str = "z") -> onnx.NodeProto:
    return helper.make_node("QuantizeLinear", [name, "s", zero], [out])


def integers(*nodes: onnx.NodeProto, **tensors: np.ndarray) -> bool:
    """Whether a graph with a weight that fits also fits with these nodes."""
    zeros = {"z": np.array(0, np.int8), "u": np.array(0, np.uint8), "s": np.array(1, np.float32)}
    return weights_fit(model_of(product("MatMul"), *nodes, w=FITS, **{**zeros, **tensors}))


TURNED = [helper.make_node("Reshape", ["q", "shape"], ["r"]), helper.make_node("Transpose", ["r"], ["t"])]
LOOKED_UP = helper.make_node("Gather", ["table", "ids"], ["g"])
AGAIN = helper.make_node("DequantizeLinear", ["q", "s", "z"], ["d"])


@pytest.mark.parametrize("kind", ["MatMulInteger", "MatMulIntegerToFloat", "QLinearMatMul", "ConvInteger"])
def test_an_activation_in_uint8_is_multiplied_exactly_and_one_in_int8_may_not_be(kind: str) -> None:
    for zero, exact in (("u", True), ("z", False)):
        assert integers(quantizer("k", "q", zero), product(kind, "q")) is exact
        assert integers(quantizer("k", "q", zero), *TURNED, product(kind, "t")) is exact
    assert integers(helper.make_node("DynamicQuantizeLinear", ["k"], ["q", "qs", "qz"]), product(kind, "q"))


@pytest.mark.parametrize("nodes", [
    [LOOKED_UP, product("MatMulInteger", "g")],
    [quantizer("f", "q"), product("MatMulInteger", "q")],
    [quantizer("f", "q"), AGAIN, product("MatMul", "d")],
    [quantizer("f", "q"), AGAIN, helper.make_node("Transpose", ["d"], ["t"]), product("Gemm", "t")],
    [helper.make_node("Cast", ["i"], ["c"], to=TensorProto.INT8), product("MatMulInteger", "c")],
    [helper.make_node("Gather", ["table", "ids"], ["g"], domain="own"), product("MatMulInteger", "g")],
    [helper.make_node("Constant", [], ["c"], value=numpy_helper.from_array(SATURATES, "table")),
     product("MatMulInteger", "c")],
    [product("MatMulInteger", "given")],
    [helper.make_node("Clip", ["f", "low", "low"], ["c"], domain="own"), product("MatMulInteger", "c")],
    [helper.make_node("QuantizeLinear", ["f", "s", "u"], ["q"], domain="own"), product("MatMulInteger", "q")],
    [helper.make_node("DequantizeLinear", ["w", "s"], ["d"], domain="own"), product("MatMulInteger", "d")],
    [quantizer("f", "q"), helper.make_node("Relu", ["i"], ["low"]),
     helper.make_node("Clip", ["q", "low", "low"], ["c"]), product("MatMulInteger", "c")],
    [helper.make_node("Relu", ["i"], ["u"]), quantizer("f", "q", "u"), product("MatMulInteger", "q")],
], ids=["looked up", "quantized there", "and dequantized", "and turned", "cast", "an operator of another domain",
        "a constant of another's name", "an input", "a clip of another domain", "a quantizer of another domain",
        "a dequantizer of another domain", "bounds of a node's name", "a zero point of a node's name"])  # fmt: skip
def test_an_int8_operand_that_the_graph_computes_may_saturate(nodes: list[onnx.NodeProto]) -> None:
    stored = {"table": SATURATES, "f": SATURATES.astype(np.float32), "i": SATURATES.astype(np.int32)}
    stored["low"] = np.array(9, np.int8)
    read = {name for node in nodes for name in node.input}  # a matrix that nothing reads would be enough for the answer
    assert not integers(*nodes, **{name: values for name, values in stored.items() if name in read})


def test_what_is_made_twice_or_reads_itself_may_saturate() -> None:
    assert not integers(quantizer("a", "q", "u"), quantizer("b", "q"), product("MatMulInteger", "q"))
    assert not integers(helper.make_node("Identity", ["q"], ["q2"]), helper.make_node("Identity", ["q2"], ["q"]),
                        quantizer("f", "q3"), product("MatMulInteger", "q3"))  # fmt: skip


def test_deep_and_wide_graphs_are_walked_once() -> None:
    nodes = [helper.make_node("DequantizeLinear", ["w", "s"], ["d0"])]
    for level in range(60):
        nodes += [helper.make_node("DequantizeLinear", [f"d{level}", "s"], [f"d{level + 1}"])] * 2
    assert not weights_fit(model_of(product("MatMul"), *nodes, product("MatMul", "d60"), w=FITS))
    joins = [quantizer("k", "c0", "u")]
    joins += [helper.make_node("Concat", [f"c{level}"] * 2, [f"c{level + 1}"], axis=0) for level in range(5000)]
    many = [helper.make_node("MatMulInteger", ["x", "c5000"], [f"y{number}"]) for number in range(5000)]
    assert integers(*joins, *many)


def test_a_node_without_an_output_and_a_weight_of_many_axes_may_saturate() -> None:
    assert not weights_fit(model_of(helper.make_node("DequantizeLinear", ["w", "s"], []), w=FITS))
    assert not weights_fit(model_of(product("MatMul"), w=np.full((1,) * 32 + (4, 2), 60, np.int8)))


@pytest.mark.parametrize(
    ("low", "high", "exact"), [(-63, 63, True), (-64, 64, True), (-65, 63, False), (-63, 100, False)]
)
def test_an_int8_activation_that_is_bounded_is_multiplied_exactly(low: int, high: int, exact: bool) -> None:
    clip = helper.make_node("Clip", ["q", "low", "high"], ["c"])
    turned = helper.make_node("Transpose", ["c"], ["t"])
    ends = {"low": np.array(low, np.int8), "high": np.array(high, np.int8)}
    assert integers(quantizer("k", "q"), clip, turned, product("MatMulIntegerToFloat", "t"), **ends) is exact
    open_end = helper.make_node("Clip", ["q", "low"], ["c"])
    assert not integers(quantizer("k", "q"), open_end, product("MatMulIntegerToFloat", "c"), **ends)
    assert integers(quantizer("k", "q", "u"), open_end, product("MatMulIntegerToFloat", "c"), **ends)
