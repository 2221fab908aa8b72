from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.errors import GraphError
from vlatool.runtime.external_data import SEARCH_BYTES
from vlatool.runtime.stored_types import FLOAT8, has_float8, lacks_zero_point


def tensor(dtype: int, size: int = 4) -> onnx.TensorProto:
    return helper.make_tensor("t", dtype, [size], bytes(size), raw=True)


def graph_of(*nodes: onnx.NodeProto, initializer: tuple[onnx.TensorProto, ...] = ()) -> onnx.GraphProto:
    return helper.make_graph(list(nodes), "main", [], [], list(initializer))


def model_of(graph: onnx.GraphProto) -> bytes:
    model: bytes = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)]).SerializeToString()
    return model


def deep(levels: int) -> bytes:
    graph = graph_of(helper.make_node("Constant", [], ["c"], value=tensor(TensorProto.FLOAT8E4M3FN)))
    for _ in range(levels):
        graph = graph_of(helper.make_node("If", ["flag"], ["c"], then_branch=graph))
    return model_of(graph)


def nested(levels: int) -> bytes:
    """Graphs in attributes of nodes, as bytes: protobuf itself would not write so many levels."""
    content = b"\x10\x11"
    for field in (6, 5, 1) * levels:
        size = len(content)
        content = bytes([field << 3 | 2, size & 127 | 128, size >> 7]) + content
    return b"\x3a" + bytes([len(content) & 127 | 128, len(content) >> 7]) + content


@pytest.mark.parametrize("dtype", FLOAT8)
@pytest.mark.parametrize("size", [1, 3 * SEARCH_BYTES])
def test_a_float8_initialiser_is_found_in_bytes_and_in_a_file(tmp_path: Path, dtype: int, size: int) -> None:
    many = [numpy_helper.from_array(np.zeros(SEARCH_BYTES, np.float32), f"w{number}") for number in range(3)]
    model = model_of(graph_of(initializer=(*many, tensor(dtype, size))))
    (tmp_path / "model.onnx").write_bytes(model)
    assert has_float8(model)
    assert has_float8(tmp_path / "model.onnx")


def test_a_float8_constant_within_branches_is_found() -> None:
    assert has_float8(deep(0))
    assert has_float8(deep(3))


@pytest.mark.parametrize("dtype", [TensorProto.INT8, TensorProto.UINT8])
def test_bytes_of_other_tensors_that_look_like_the_type_are_none(tmp_path: Path, dtype: int) -> None:
    content = bytes([16, 17, 16, 18]) * SEARCH_BYTES
    other = helper.make_tensor("\x10\x11", dtype, [len(content)], content, raw=True)
    model = model_of(graph_of(helper.make_node("Add", ["\x10\x11", "\x10\x11"], ["y"]), initializer=(other,)))
    (tmp_path / "model.onnx").write_bytes(model)
    assert not has_float8(model)
    assert not has_float8(tmp_path / "model.onnx")


def test_what_is_no_graph_or_too_deep_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="not an ONNX model"):
        has_float8(b"\x10\x11 no graph")
    with pytest.raises(GraphError, match="graph_depth"):
        has_float8(nested(60))
    with pytest.raises(FileNotFoundError):
        has_float8(tmp_path / "none.onnx")


@pytest.mark.parametrize(
    ("kind", "inputs", "lacks"),
    [
        ("MatMulInteger", ["a", "w", "z"], True), ("MatMulInteger", ["a", "w", "", ""], True),
        ("MatMulInteger", ["a", "w", "", "z"], True), ("MatMulInteger", ["a", "w", "y", "z"], False),
        ("DequantizeLinear", ["w", "s"], True), ("DequantizeLinear", ["w", "s", "z"], False),
        ("MatMul", ["a", "b"], False),
    ],
)  # fmt: skip
def test_a_node_without_a_zero_point_is_found(tmp_path: Path, kind: str, inputs: list[str], lacks: bool) -> None:
    many = [
        numpy_helper.from_array(np.zeros(SEARCH_BYTES, np.float32), f"MatMulInteger{number}") for number in range(3)
    ]
    model = model_of(graph_of(helper.make_node(kind, inputs, ["y"]), initializer=(*many,)))
    (tmp_path / "model.onnx").write_bytes(model)
    assert lacks_zero_point(model) is lacks
    assert lacks_zero_point(tmp_path / "model.onnx") is lacks
    within = graph_of(
        helper.make_node("If", ["flag"], ["c"], then_branch=graph_of(helper.make_node(kind, inputs, ["y"])))
    )
    assert lacks_zero_point(model_of(within)) is lacks
