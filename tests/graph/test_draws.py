"""Random numbers inside a graph are found wherever they are drawn."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.graph.draws import drawing

UNIFORM = helper.make_node("RandomUniform", [], ["drawn"], shape=[1], seed=7.0)


def model(nodes: list[onnx.NodeProto], functions: list[onnx.FunctionProto] | None = None) -> onnx.ModelProto:
    graph = helper.make_graph(nodes, "main", [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])], [])
    return helper.make_model(graph, functions=functions or [])


def test_a_draw_of_the_graph_is_found():
    assert drawing(model([UNIFORM, helper.make_node("Add", ["x", "drawn"], ["y"])])) == ("RandomUniform",)


def test_a_draw_of_a_branch_inside_a_branch_is_found():
    inner = helper.make_graph([UNIFORM], "inner", [], [helper.make_tensor_value_info("drawn", TensorProto.FLOAT, [1])])
    condition = helper.make_node("If", ["c"], ["z"], then_branch=inner, else_branch=inner)
    outer = helper.make_graph([condition], "outer", [], [helper.make_tensor_value_info("z", TensorProto.FLOAT, [1])])
    assert drawing(model([helper.make_node("If", ["c"], ["y"], then_branch=outer, else_branch=outer)])) == (
        "RandomUniform",
    )


def test_a_draw_of_a_function_is_found():
    function = helper.make_function("own", "Harmless", [], ["drawn"], [UNIFORM], [helper.make_opsetid("", 18)])
    assert drawing(model([helper.make_node("Harmless", [], ["y"], domain="own")], [function])) == ("RandomUniform",)


@pytest.mark.parametrize(
    ("operator", "domain", "inputs"),
    [
        ("Dropout", "", ["x", "ratio", "training"]),
        ("BiasDropout", "com.microsoft", ["x", "bias", "residual", "ratio", "training"]),
        ("BitmaskDropout", "com.microsoft", ["x", "ratio", "training"]),
        ("Bernoulli", "", ["x"]),
        ("Multinomial", "", ["x"]),
        ("Sampling", "com.microsoft", ["x"]),
    ],
)
def test_operators_that_draw(operator: str, domain: str, inputs: list[str]):
    assert drawing(model([helper.make_node(operator, inputs, ["y"], domain=domain)])) == (operator,)


@pytest.mark.parametrize("inputs", [["x"], ["x", "ratio"], ["x", "ratio", ""]])
def test_a_dropout_that_does_not_train_draws_nothing(inputs: list[str]):
    ratio = numpy_helper.from_array(np.float32(0.5), "ratio")
    made = model([helper.make_node("Dropout", inputs, ["y"])])
    made.graph.initializer.append(ratio)
    assert drawing(made) == ()
