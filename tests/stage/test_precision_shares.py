import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.graph.precision import shares_and_unknown
from vlatool.stage.precision_shares import count_shares


def weight(name: str, *shape: int) -> onnx.TensorProto:
    return numpy_helper.from_array(np.ones(shape, np.float32), name)


def padded(path: Path, kind: int = TensorProto.FLOAT, wrong: bool = False) -> Path:
    """A convolution behind a Pad whose widths the graph computes, and a product behind that."""
    nodes = [
        helper.make_node("Cast", ["half"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Concat", ["zeros", "whole", "zeros", "whole"], ["pads"], axis=0),
        helper.make_node("Pad", ["x", "pads"], ["p"]),
        helper.make_node("Conv", ["p", "w"], ["a"], "convolution"),
        helper.make_node("ReduceMean", ["a"], ["m"], axes=[2], keepdims=0),
        helper.make_node("MatMul", ["m", "v"], ["y"], "product"),
    ]
    x, y = (helper.make_tensor_value_info(name, kind, shape) for name, shape in (("x", [1, 4, 32]), ("y", [1, 6])))
    numbers = [
        numpy_helper.from_array(np.zeros(2, np.int64), "zeros"),
        numpy_helper.from_array(np.float32([2]), "half"),
    ]
    weights = [weight("w", 8, 4, 3), weight("v", 9 if wrong else 8, 6), *numbers]
    graph = helper.make_graph(nodes, "g", [x], [y], weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return path


def test_a_run_shows_what_shape_inference_loses(tmp_path: Path) -> None:
    path = padded(tmp_path / "main.onnx")
    assert shares_and_unknown(path) == ({}, ("convolution", "product"))
    assert count_shares(path) == ({"float32": 1.0}, ())
    assert shares_and_unknown(path) == ({"float32": 1.0}, ()), "noted in the file, for all who count it later"


def test_a_graph_that_has_its_weights_beside_it_keeps_them_there(tmp_path: Path) -> None:
    path = padded(tmp_path / "main.onnx")
    onnx.save(onnx.load(path), path, save_as_external_data=True, location="main.onnx.data", size_threshold=64)
    before = (tmp_path / "main.onnx.data").read_bytes()
    assert count_shares(path) == ({"float32": 1.0}, ())
    assert (tmp_path / "main.onnx.data").read_bytes() == before
    assert path.stat().st_size < 2000


def test_what_does_not_run_is_named_as_not_counted(tmp_path: Path) -> None:
    _, messages = count_shares(padded(tmp_path / "main.onnx", wrong=True))
    assert messages == ("main: not counted, for want of fixed shapes: convolution, product",)


@pytest.mark.parametrize("noted", ["nothing", "another layer"])
def test_what_was_noted_before_stays_for_layers_that_are_the_same(tmp_path: Path, noted: str) -> None:
    path = padded(tmp_path / "main.onnx")
    count_shares(path)
    copy = tmp_path / "copy.onnx"
    shutil.copy(path, copy)
    model = onnx.load(copy)
    model.graph.node[5].name = "renamed"
    if noted == "nothing":
        del model.metadata_props[:]
    onnx.save(model, copy)
    assert count_shares(copy) == ({"float32": 1.0}, ())
    assert shares_and_unknown(copy)[1] == ()
