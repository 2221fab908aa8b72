"""Lookups and edits of a graph: who gives and reads a value, constants, types, shapes, order."""

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import numpy_helper

from vlatool.graph.onnx_graph import FLOAT, OnnxGraph

TEXT = """<ir_version: 10, opset_import: ["" : 20]> g (float[2,3] x, bool c) => (float[2,4] y)
    { h = MatMul(x, w)
      i = If(c) <then_branch = t () => (float[2,4] u) { u = Add(h, one) },
                 else_branch = e () => (float[2,4] v) { v = Relu(h) }>
      unread = Neg(h)
      y = Add(i, one) }"""


@pytest.fixture
def graph() -> OnnxGraph:
    model = onnx.parser.parse_model(TEXT)
    constants = {"w": np.ones((3, 4), np.float32), "one": np.ones((1, 1), np.float32), "axes": np.array([0, 1])}
    model.graph.initializer.extend(numpy_helper.from_array(values, name) for name, values in constants.items())
    return OnnxGraph(model)


def kinds(graph: OnnxGraph) -> list[str]:
    return [node.op_type for node in graph.graph.node]


def test_readers_inside_of_branches_count(graph):
    assert [node.op_type for node in graph.readers["h"]] == ["If", "If", "Neg"]
    assert [node.op_type for node in graph.readers["one"]] == ["If", "Add"]
    assert graph.readers["nothing"] == []
    assert graph.producers["i"].op_type == "If"
    assert "x" not in graph.producers


def test_constants_are_known_by_type_and_shape(graph):
    assert graph.is_weight("w")
    assert graph.is_weight("w", rank=2)
    assert not graph.is_weight("w", rank=1)
    assert not graph.is_weight("axes")
    assert [name for name in ("w", "one", "x") if graph.is_scalar(name)] == ["one"]
    assert (graph.types["h"], graph.shapes["h"], graph.shapes["w"]) == (FLOAT, (2, 4), (3, 4))
    assert graph.float_values() == ["h", "i", "unread", "y"]


def test_a_constant_is_added_once(graph):
    assert graph.add("w", np.zeros(1)) == "w"
    assert graph.array("w").shape == (3, 4)
    assert graph.add("half", 0.5, np.float32) == "half"
    assert graph.add_tensor(graph.constants["w"], "copy") == "copy"
    assert [tensor.name for tensor in graph.graph.initializer] == ["w", "one", "axes", "half", "copy"]
    np.testing.assert_array_equal(graph.array("copy"), graph.array("w"))


def test_what_leads_to_no_output_is_dropped(graph):
    graph.drop_unread()
    assert kinds(graph) == ["MatMul", "If", "Add"]
    assert [tensor.name for tensor in graph.graph.initializer] == ["w", "one"]


def test_nodes_are_put_before_others_and_sorted(graph):
    last = graph.graph.node[3]
    graph.insert_before(last, graph.node("Abs", ["i"], ["a"]), graph.node("Exp", ["a"], ["b"]))
    graph.replace_reads("i", "b")
    assert kinds(graph) == ["MatMul", "If", "Neg", "Abs", "Exp", "Add"]
    assert list(graph.graph.node[5].input) == ["b", "one"]
    graph.graph.node[3].input[0] = "i"
    ordered = list(graph.graph.node)
    graph.replace_nodes([ordered[place] for place in (5, 2, 4, 1, 3, 0)])
    graph.sort()
    assert kinds(graph) == ["MatMul", "Neg", "If", "Abs", "Exp", "Add"]
    onnx.checker.check_model(graph.model)
