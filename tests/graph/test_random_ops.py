"""Random numbers inside a graph are found wherever they are drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.errors import GraphError
from vlatool.graph.random_ops import random_operators, refuse_random_file

UNIFORM = helper.make_node("RandomUniform", [], ["drawn"], shape=[1], seed=7.0)


def model(nodes: list[onnx.NodeProto], functions: list[onnx.FunctionProto] | None = None) -> onnx.ModelProto:
    graph = helper.make_graph(nodes, "main", [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])], [])
    return helper.make_model(graph, functions=functions or [])


def test_a_draw_of_the_graph_is_found():
    assert random_operators(model([UNIFORM, helper.make_node("Add", ["x", "drawn"], ["y"])])) == ("RandomUniform",)


def test_a_draw_of_a_branch_inside_a_branch_is_found():
    inner = helper.make_graph([UNIFORM], "inner", [], [helper.make_tensor_value_info("drawn", TensorProto.FLOAT, [1])])
    condition = helper.make_node("If", ["c"], ["z"], then_branch=inner, else_branch=inner)
    outer = helper.make_graph([condition], "outer", [], [helper.make_tensor_value_info("z", TensorProto.FLOAT, [1])])
    assert random_operators(model([helper.make_node("If", ["c"], ["y"], then_branch=outer, else_branch=outer)])) == (
        "RandomUniform",
    )


def test_a_draw_of_a_function_is_found():
    function = helper.make_function("own", "Harmless", [], ["drawn"], [UNIFORM], [helper.make_opsetid("", 18)])
    assert random_operators(model([helper.make_node("Harmless", [], ["y"], domain="own")], [function])) == (
        "RandomUniform",
    )


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
    assert random_operators(model([helper.make_node(operator, inputs, ["y"], domain=domain)])) == (operator,)


def held(nodes: list[onnx.NodeProto], functions: list[onnx.FunctionProto] | None = None, *, training: bool):
    made = model(nodes, functions)
    for name, value in (("ratio", np.float32(0.5)), ("training", np.bool_(training))):
        made.graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    return made


@pytest.mark.parametrize("inputs", [["x"], ["x", "ratio"], ["x", "ratio", ""], ["x", "ratio", "training"]])
def test_a_dropout_that_does_not_train_draws_nothing(inputs: list[str]):
    assert random_operators(held([helper.make_node("Dropout", inputs, ["y"])], training=False)) == ()


def test_a_dropout_that_a_constant_node_switches_off_draws_nothing():
    off = helper.make_node("Constant", [], ["never"], value=numpy_helper.from_array(np.asarray(False)))
    assert (
        random_operators(held([off, helper.make_node("Dropout", ["x", "ratio", "never"], ["y"])], training=True)) == ()
    )


def test_a_dropout_that_trains_or_may_draws():
    dropout = helper.make_node("Dropout", ["x", "ratio", "training"], ["y"])
    assert random_operators(held([dropout], training=True)) == ("Dropout",)
    fed = held([dropout], training=False)
    fed.graph.input.append(helper.make_tensor_value_info("training", TensorProto.BOOL, []))
    assert random_operators(fed) == ("Dropout",), "an input overrules the constant"
    opset = [helper.make_opsetid("", 18)]
    inside = helper.make_function("own", "Harmless", ["x", "ratio", "training"], ["y"], [dropout], opset)
    call = helper.make_node("Harmless", ["x", "ratio", "on"], ["y"], domain="own")
    assert random_operators(held([call], [inside], training=False)) == ("Dropout",), (
        "in a function the name is another value"
    )


def test_a_name_of_a_function_of_its_own_is_no_operator():
    body = [helper.make_node("Identity", ["x"], ["y"])]
    function = helper.make_function("own", "Bernoulli", ["x"], ["y"], body, [helper.make_opsetid("", 18)])
    assert random_operators(model([helper.make_node("Bernoulli", ["x"], ["y"], domain="own")], [function])) == ()


def test_a_file_that_trains_is_refused_as_a_source_with_what_to_do():
    made = model([helper.make_node("Dropout", ["x", "ratio", "training"], ["y"])])
    with pytest.raises(GraphError, match=r"a\.onnx draws random numbers, once an inference \(Dropout\)") as caught:
        refuse_random_file(made, Path("a.onnx"))
    assert "module.eval()" in caught.value.fix
