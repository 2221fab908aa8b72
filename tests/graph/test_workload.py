from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import GraphError
from vlatool.graph.shapes import open_graph
from vlatool.graph.workload import GraphWorkload, Workload, graph_workload, workload

FLOAT = TensorProto.FLOAT
Build = Callable[..., GraphWorkload]


def weight(name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> onnx.TensorProto:
    return numpy_helper.from_array(np.ones(shape, dtype), name)


def value(name: str, shape: list[int | str] | None, kind: int = FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def save(
    path: Path,
    nodes: list[onnx.NodeProto],
    shape: list[int | str],
    weights: list[onnx.TensorProto],
    kind: int = FLOAT,
    opset: int = 21,
    functions: list[onnx.FunctionProto] | None = None,
    note: str = "",
) -> Path:
    graph = helper.make_graph(nodes, "g", [value("x", shape, kind)], [value("y", None, kind)], weights)
    imports = [helper.make_opsetid("", opset), helper.make_opsetid("com.microsoft", 1), helper.make_opsetid("own", 1)]
    model = helper.make_model(graph, opset_imports=imports, functions=functions or [])
    if note:
        model.metadata_props.add(key="vlatool.seen", value=note)
    path.write_bytes(model.SerializeToString())
    return path


@pytest.fixture
def count(tmp_path: Path) -> Build:
    def build(*arguments: Any, **options: Any) -> GraphWorkload:
        return graph_workload(save(tmp_path / "m.onnx", *arguments, **options))

    return build


def test_matmul(count: Build) -> None:
    found = count([helper.make_node("MatMul", ["x", "w"], ["y"])], [2, 3, 5], [weight("w", (5, 7))])
    assert found.macs == {"float32": 2 * 3 * 7 * 5}
    assert found.layers == 1
    assert found.weight_bytes == 5 * 7 * 4
    assert found.activation_bytes == 2 * 3 * 7 * 4
    assert found.peak_bytes == (2 * 3 * 5 + 2 * 3 * 7) * 4
    assert not found.integer_ops
    assert not found.unknown


@pytest.mark.parametrize("transposed", [0, 1])
def test_gemm(count: Build, transposed: int) -> None:
    node = helper.make_node("Gemm", ["x", "w", "b"], ["y"], transA=transposed, transB=1)
    found = count([node], [5, 3] if transposed else [3, 5], [weight("w", (7, 5)), weight("b", (7,))])
    assert found.macs == {"float32": 3 * 7 * 5}
    assert found.weight_bytes == (35 + 7) * 4


def test_convolution_with_groups_and_strides(count: Build) -> None:
    node = helper.make_node("Conv", ["x", "w"], ["y"], group=2, strides=[2, 2], pads=[1, 1, 1, 1])
    found = count([node], [1, 4, 8, 8], [weight("w", (6, 2, 3, 3))])
    assert found.macs == {"float32": (6 * 4 * 4) * (2 * 3 * 3)}


def test_transposed_convolution(count: Build) -> None:
    node = helper.make_node("ConvTranspose", ["x", "w"], ["y"], strides=[2, 2])
    found = count([node], [1, 4, 5, 5], [weight("w", (4, 3, 2, 2))])
    assert found.macs == {"float32": (4 * 5 * 5) * (3 * 2 * 2)}


def test_half_precision(count: Build) -> None:
    node = helper.make_node("MatMul", ["x", "w"], ["y"])
    found = count([node], [2, 4], [weight("w", (4, 4), np.float16)], kind=TensorProto.FLOAT16)
    assert found.macs == {"float16": 2 * 4 * 4}
    assert found.weight_bytes == 32
    assert found.activation_bytes == 16


def qdq(name: str, source: str, scale: str = "s", zero: str = "z") -> list[onnx.NodeProto]:
    return [
        helper.make_node("QuantizeLinear", [source, scale, zero], [f"{name}_q"]),
        helper.make_node("DequantizeLinear", [f"{name}_q", scale, zero], [name]),
    ]


def test_qdq_counts_as_int8(count: Build) -> None:
    nodes = [
        *qdq("xd", "x"),
        helper.make_node("DequantizeLinear", ["w", "s", "zw"], ["wd"]),
        helper.make_node("Conv", ["xd", "wd"], ["c"]),
        helper.make_node("Flatten", ["c"], ["f"]),
        helper.make_node("MatMul", ["f", "head"], ["y"]),
    ]
    weights = [
        weight("w", (8, 3, 3, 3), np.int8),
        weight("s", ()),
        weight("z", (), np.uint8),
        weight("zw", (), np.int8),
        weight("head", (8 * 4, 2)),
    ]
    found = count(nodes, [1, 3, 4, 4], weights, opset=17)
    assert found.macs == {"int8": (8 * 2 * 2) * (3 * 3 * 3), "float32": 32 * 2}
    assert found.weight_bytes == 8 * 27 + 4 + 1 + 1 + 32 * 2 * 4


def test_qdq_next_to_float(count: Build) -> None:
    nodes = [
        *qdq("xd", "x"),
        helper.make_node("DequantizeLinear", ["w", "s", "zw"], ["wd"]),
        helper.make_node("MatMul", ["xd", "wd"], ["h"]),
        helper.make_node("MatMul", ["h", "wd"], ["y"]),
    ]
    weights = [weight("w", (5, 5), np.int8), weight("s", ()), weight("z", (), np.uint8), weight("zw", (), np.int8)]
    found = count(nodes, [3, 5], weights)
    assert found.macs == {"int8": 75, "float32": 75}, "a dequantized weight alone is computed in float"
    assert found.weight_bytes == 25 + 4 + 1 + 1
    assert found.peak_bytes == (15 + 15 + 15) * 4, "the dequantized weight is not alive"
    assert not found.integer_ops


def test_four_bit_qdq(count: Build) -> None:
    packed = helper.make_tensor("w", TensorProto.INT4, [4, 4], [1] * 16)
    nodes = [
        *qdq("xd", "x"),
        helper.make_node("DequantizeLinear", ["w", "s"], ["wd"]),
        helper.make_node("MatMul", ["xd", "wd"], ["y"]),
    ]
    found = count(nodes, [2, 4], [packed, weight("s", ()), weight("z", (), np.int8)])
    assert found.macs == {"int4": 32}
    assert found.weight_bytes == 8 + 4 + 1


def test_dynamic_int8(count: Build) -> None:
    nodes = [
        helper.make_node("DynamicQuantizeLinear", ["x"], ["xq", "xs", "xz"]),
        helper.make_node("MatMulInteger", ["xq", "w", "xz"], ["i"]),
        helper.make_node("Cast", ["i"], ["f"], to=FLOAT),
        helper.make_node("Mul", ["f", "xs"], ["y"]),
    ]
    found = count(nodes, [4, 16], [weight("w", (16, 8), np.int8)])
    assert found.macs == {"int8": 4 * 8 * 16}
    assert found.integer_ops
    assert found.weight_bytes == 128
    assert found.activation_bytes == 4 * 8 * 4


def test_integer_convolution_and_qlinear(count: Build) -> None:
    scale, zero, zw = weight("s", ()), weight("z", (), np.uint8), weight("zw", (), np.int8)
    nodes = [
        helper.make_node("QLinearConv", ["x", "s", "z", "w", "s", "zw", "s", "z"], ["c"]),
        helper.make_node("QLinearMatMul", ["c", "s", "z", "v", "s", "zw", "s", "z"], ["m"]),
        helper.make_node("ConvInteger", ["m", "w"], ["y"]),
    ]
    weights = [weight("w", (3, 3, 1, 1), np.int8), weight("v", (4, 4), np.int8), scale, zero, zw]
    found = count(nodes, [1, 3, 4, 4], weights, kind=TensorProto.UINT8)
    assert found.macs == {"int8": 48 * 3 + 48 * 4 + 48 * 3}
    assert found.layers == 3


def test_contributed_operators(count: Build) -> None:
    own = {"domain": "com.microsoft"}
    nodes = [
        helper.make_node("MatMulNBits", ["x", "b", "bs"], ["a"], K=16, N=32, bits=4, block_size=16, **own),
        helper.make_node("Relu", ["a"], ["r"]),
        helper.make_node("DynamicQuantizeMatMul", ["r", "w", "s"], ["d"], **own),
        helper.make_node("QGemm", ["d", "s", "z", "v", "s", "z"], ["y"], transB=1, **own),
    ]
    weights = [
        weight("b", (32, 1, 8), np.uint8),
        weight("bs", (32,)),
        weight("w", (32, 8), np.int8),
        weight("v", (2, 8), np.int8),
        weight("s", ()),
        weight("z", (), np.int8),
    ]
    found = count(nodes, [3, 16], weights)
    assert found.macs == {"int4": 3 * 32 * 16, "int8": 3 * 8 * 32 + 3 * 2 * 8}
    assert found.unknown == ()


def test_integer_product_to_float_leaves_float(count: Build) -> None:
    own = {"domain": "com.microsoft"}
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "s", "z"], ["q"]),
        helper.make_node("MatMulIntegerToFloat", ["q", "w", "s", "s", "z", "zw"], ["f"], **own),
        helper.make_node("MatMul", ["f", "v"], ["y"]),
    ]
    weights = [weight("w", (8, 8), np.int8), weight("s", ()), weight("z", (), np.uint8), weight("zw", (), np.int8)]
    found = count(nodes, [1, 8], [*weights, weight("v", (8, 2))])
    assert found.macs == {"int8": 64, "float32": 16}
    assert found.activation_bytes == 8 * 4 + 2 * 4


def test_fused_convolution_keeps_its_strides(count: Build) -> None:
    node = helper.make_node("FusedConv", ["x", "w"], ["y"], domain="com.microsoft", strides=[2, 2])
    assert count([node], [1, 2, 4, 4], [weight("w", (3, 2, 2, 2))]).macs == {"float32": 12 * 8}


def test_einsum(count: Build) -> None:
    node = helper.make_node("Einsum", ["x", "w"], ["y"], equation="bsd, dh -> bsh")
    assert count([node], [2, 3, 4], [weight("w", (4, 5))]).macs == {"float32": 2 * 3 * 4 * 5}
    node = helper.make_node("Einsum", ["x", "w"], ["y"], equation="...d,dh->...h")
    assert count([node], [2, 3, 4], [weight("w", (4, 5))]).unknown == ("y",)


@pytest.mark.parametrize("four", [True, False])
def test_attention(count: Build, four: bool) -> None:
    heads: dict[str, Any] = {} if four else {"q_num_heads": 4, "kv_num_heads": 2}
    node = helper.make_node("Attention", ["x", "k", "v"], ["y"], **heads)
    if four:  # batch 1, 4 heads, 3 queries, 5 keys, widths 8 and 6
        found = count([node], [1, 4, 3, 8], [weight("k", (1, 4, 5, 8)), weight("v", (1, 4, 5, 6))], opset=23)
        assert found.macs == {"float32": 4 * 3 * 5 * (8 + 6)}
    else:  # two key-value heads that four query heads share
        found = count([node], [1, 3, 32], [weight("k", (1, 5, 16)), weight("v", (1, 5, 12))], opset=23)
        assert found.macs == {"float32": 4 * 3 * 5 * (8 + 6)}


def test_attention_of_others_and_caches_is_unknown(count: Build) -> None:
    node = helper.make_node("Attention", ["x", "k", "v"], ["y"], domain="com.microsoft")
    assert count([node], [1, 3, 8], [weight("k", (8, 24)), weight("v", (24,))]).unknown == ("y",)
    node = helper.make_node("FusedMatMul", ["x", "k"], ["y"], name="fused", domain="com.microsoft")
    assert count([node], [1, 3, 8], [weight("k", (8, 24))]).unknown == ("fused",)


def test_recurrent_layer(count: Build) -> None:
    node = helper.make_node("LSTM", ["x", "w", "r"], ["y"], hidden_size=6)
    found = count([node], [5, 2, 4], [weight("w", (1, 24, 4)), weight("r", (1, 24, 6))])
    assert found.macs == {"float32": 5 * 2 * 24 * (4 + 6)}


def test_a_free_first_axis_counts_once_and_others_are_unknown(count: Build) -> None:
    node = helper.make_node("MatMul", ["x", "w"], ["y"], name="proj")
    assert count([node], ["batch", 3, 5], [weight("w", (5, 7))]).macs == {"float32": 105}
    found = count([node], [1, "tokens", 5], [weight("w", (5, 7))])
    assert found.macs == {}
    assert found.unknown == ("proj",)
    assert found.layers == 1


def test_shapes_follow_data(count: Build) -> None:
    nodes = [
        helper.make_node("Shape", ["x"], ["n"], start=0, end=1),
        helper.make_node("Concat", ["n", "rest"], ["to"], axis=0),
        helper.make_node("Reshape", ["x", "to"], ["r"]),
        helper.make_node("MatMul", ["r", "w"], ["y"]),
    ]
    rest = numpy_helper.from_array(np.array([12], np.int64), "rest")
    assert count(nodes, ["b", 3, 4], [weight("w", (12, 2)), rest]).macs == {"float32": 24}


def chosen(first: int, second: int) -> list[Any]:
    """An If with a product of so many columns in one branch and in the other, under the same names."""
    bodies = [
        helper.make_graph([helper.make_node("MatMul", ["x", f"w{n}"], ["o"], "p")], "b", [], [value("o", [2, n])])
        for n in (first, second)
    ]
    return [
        helper.make_node("ReduceMax", ["x"], ["m"], keepdims=0),
        helper.make_node("Cast", ["m"], ["c"], to=TensorProto.BOOL),
        helper.make_node("If", ["c"], ["y"], name="choose", then_branch=bodies[0], else_branch=bodies[1]),
    ]


@pytest.mark.parametrize("columns", [(3, 5), (5, 3)])
def test_of_two_branches_the_dearer_one_counts(count: Build, columns: tuple[int, int]) -> None:
    found = count(chosen(*columns), [2, 2], [weight("w3", (2, 3)), weight("w5", (2, 5))])
    assert (found.macs, found.layers, found.unknown) == ({"float32": 20}, 1, ())
    assert (found.weights, found.activations) == (10, 10)


def looped(trips: str) -> list[Any]:
    body = helper.make_graph(
        [
            helper.make_node("MatMul", ["s", "w"], ["t"], "turn"),
            helper.make_node("MatMul", ["t", "inside"], ["u"], "again"),
            helper.make_node("Identity", ["go"], ["on"]),
        ],
        "body",
        [value("i", [], TensorProto.INT64), value("go", [], TensorProto.BOOL), value("s", [2, 2])],
        [value("on", [], TensorProto.BOOL), value("u", [2, 2]), value("t", [2, 2])],
        [weight("inside", (2, 2))],
    )
    nodes = [helper.make_node("Loop", [trips, "", "x"], ["last", "all"], name="loop", body=body)]
    return [*nodes, helper.make_node("MatMul", ["all", "v"], ["y"], "after")]


@pytest.mark.parametrize("trips", [0, 1, 7])
def test_the_turns_of_a_loop_count(count: Build, trips: int) -> None:
    turns = numpy_helper.from_array(np.array(trips), "n")
    found = count(looped("n"), [2, 2], [turns, weight("w", (2, 2)), weight("v", (2, 3))])
    if trips:
        assert (found.macs, found.unknown) == ({"float32": trips * (8 + 8) + trips * 12}, ())
        assert (found.layers, found.weights, found.read_again) == (2 * trips + 1, 14, 8 * (trips - 1))
    else:
        assert found.unknown == ("after",), "what it stacks has no length"


def test_a_loop_that_ends_nobody_knows_when_has_layers_that_are_named(count: Build) -> None:
    found = count(looped(""), [2, 2], [weight("w", (2, 2)), weight("v", (2, 3))])
    assert set(found.unknown) == {"turn", "again", "after"}


def test_a_run_that_was_noted_counts_what_no_shape_says(count: Build) -> None:
    note = {"turn": [3, [[2, 2]], [[2, 2]]], "again": [3, [[2, 2]], [[2, 2]]], "after": [1, [[3, 2, 2]], [[3, 2, 3]]]}
    found = count(looped(""), [2, 2], [weight("w", (2, 2)), weight("v", (2, 3))], note=json.dumps(note))
    assert (found.macs, found.unknown) == ({"float32": 3 * 16 + 36}, ())
    spoiled = count(looped(""), [2, 2], [weight("w", (2, 2)), weight("v", (2, 3))], note='{"turn": 3}')
    assert spoiled.unknown


@pytest.mark.parametrize("axis", [0, 1])
def test_a_scan_counts_once_for_each_entry_of_what_it_reads(count: Build, axis: int) -> None:
    body = helper.make_graph(
        [helper.make_node("MatMul", ["row", "w"], ["out"], "each")],
        "body",
        [value("row", [2, 2])],
        [value("out", [2, 3])],
    )
    scan = helper.make_node("Scan", ["x"], ["y"], body=body, num_scan_inputs=1, scan_input_axes=[axis])
    shape = [4, 2, 2] if axis == 0 else [2, 4, 2]
    assert count([scan], shape, [weight("w", (2, 3))]).macs == {"float32": 4 * 12}


def test_functions_are_looked_into(count: Build) -> None:
    body = [helper.make_node("MatMul", ["a", "b"], ["c"])]
    function = helper.make_function("own", "Layer", ["a", "b"], ["c"], body, [helper.make_opsetid("", 21)])
    node = helper.make_node("Layer", ["x", "w"], ["y"], domain="own")
    assert count([node], [2, 3], [weight("w", (3, 4))], functions=[function]).macs == {"float32": 24}


def test_live_tensors_are_freed(count: Build) -> None:
    nodes = [helper.make_node("Relu", [f"h{n}" if n else "x"], [f"h{n + 1}" if n < 9 else "y"]) for n in range(10)]
    assert count(nodes, [100], []).peak_bytes == 3 * 400, "the input, one value and the next"


def test_large_and_external_weights_are_not_read(tmp_path: Path) -> None:
    model = onnx.load(
        save(tmp_path / "m.onnx", [helper.make_node("MatMul", ["x", "w"], ["y"])], [1, 64], [weight("w", (64, 64))])
    )
    inline = graph_workload(tmp_path / "m.onnx")
    onnx.save(model, tmp_path / "e.onnx", save_as_external_data=True, location="e.data", size_threshold=0)
    (tmp_path / "e.data").unlink()
    assert graph_workload(tmp_path / "e.onnx") == inline
    assert inline.weight_bytes == 64 * 64 * 4


@pytest.mark.parametrize("content", [b"\x08\xff\xff nonsense", None])
def test_what_is_no_graph_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "m.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(GraphError, match="cannot be read as ONNX"):
        graph_workload(path)


def test_a_bundle_counts_the_repeats_of_its_program(tmp_path: Path) -> None:
    (tmp_path / "graphs").mkdir()
    node = helper.make_node("MatMul", ["x", "w"], ["y"])
    save(tmp_path / "graphs" / "prefix.onnx", [node], [1, 4], [weight("w", (4, 4))])
    save(tmp_path / "graphs" / "step.onnx", [node], [1, "free", 4], [weight("w", (4, 4))])
    files = {f"graphs/{name}.onnx": FileRecord("0" * 64, 1) for name in ("prefix", "step")}
    spec = PolicySpec((TensorSpec("x", (1, 4)),), (TensorSpec("y", (1, 4)),), 10.0)
    program = (ProgramStep("prefix", {"x": "x"}, {"y": "h"}), ProgramStep("step", {"x": "h"}, {"y": "y"}, repeat=10))
    graphs = {name: Graph(f"graphs/{name}.onnx") for name in ("prefix", "step")}
    manifest = Manifest("p", "1.0.0", spec, graphs, program, files)
    found = workload(Bundle(tmp_path, manifest))
    assert found.runs == {"prefix": 1, "step": 10}
    assert found.layers == 11
    assert found.weight_bytes == 2 * 64
    assert found.unknown == ("step/y",)


def test_totals() -> None:
    one = GraphWorkload({"int8": 100, "float32": 10}, 3, weight_bytes=1000, peak_bytes=70)
    other = GraphWorkload({"int8": 1}, 1, weight_bytes=10, peak_bytes=7)
    found = Workload({"a": one, "b": other, "unused": one}, {"a": 2, "b": 5})
    assert found.macs == {"int8": 205, "float32": 20}
    assert (found.layers, found.weight_bytes, found.peak_bytes) == (11, 2010, 147)


def test_numbers_are_counted_however_they_are_stored(count: Build) -> None:
    nodes = [
        *qdq("xd", "x"),
        helper.make_node("DequantizeLinear", ["w", "s", "zw"], ["wd"]),
        helper.make_node("Transpose", ["wd"], ["wt"], perm=[1, 0]),
        helper.make_node("MatMul", ["xd", "wt"], ["y"]),
    ]
    weights = [weight("w", (7, 5), np.int8), weight("s", ()), weight("z", (), np.uint8), weight("zw", (), np.int8)]
    found = count(nodes, [3, 5], weights)
    assert (found.weights, found.activations) == (7 * 5, 3 * 7)


def test_a_product_of_activations_has_no_weights(count: Build) -> None:
    nodes = [helper.make_node("Transpose", ["x"], ["t"], perm=[1, 0]), helper.make_node("MatMul", ["x", "t"], ["y"])]
    found = count(nodes, [4, 6], [])
    assert (found.weights, found.activations) == (0, 16)
    assert found.traits == {"attention"}


@pytest.mark.parametrize(
    ("attributes", "shape", "trait"),
    [
        ({"group": 8}, (8, 1, 3, 3), "depthwise"),
        ({"group": 2}, (32, 128, 3, 3), "grouped"),
        ({}, (8, 8, 3, 3), ""),
    ],
    ids=["depthwise", "grouped", "plain"],
)
def test_traits_of_convolutions(count: Build, attributes: dict[str, int], shape: tuple[int, ...], trait: str) -> None:
    node = helper.make_node("Conv", ["x", "w"], ["y"], pads=[1, 1, 1, 1], **attributes)
    found = count([node], [1, shape[1] * attributes.get("group", 1), 8, 8], [weight("w", shape)])
    assert found.traits == ({trait} if trait else set())
    assert found.weights == int(np.prod(shape))


def test_traits_of_branches_and_of_one_row(count: Build) -> None:
    nodes = [
        helper.make_node("MatMul", ["x", "w"], ["a"]),
        helper.make_node("Concat", ["a", "x"], ["y"], axis=1),
    ]
    assert count(nodes, [1, 5], [weight("w", (5, 5))]).traits == {"branches", "dense"}
    assert count(nodes[:1], [9, 5], [weight("w", (5, 5))]).traits == set()


def test_weights_packed_in_four_bits_are_counted_as_numbers(count: Build) -> None:
    node = helper.make_node(
        "MatMulNBits", ["x", "w", "s"], ["y"], domain="com.microsoft", K=32, N=8, bits=4, block_size=32
    )
    found = count([node], [3, 32], [weight("w", (8, 1, 16), np.uint8), weight("s", (8,))])
    assert found.weights == 32 * 8


def test_what_a_shape_leads_to_is_no_weight(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Constant", [], ["c"], value=helper.make_tensor("c", FLOAT, [2], [1.0, 2.0])),
        helper.make_node("Cast", ["w"], ["wc"], to=FLOAT),
        helper.make_node("Relu", ["w"], ["r"]),
        helper.make_node("Mul", ["x", "w"], ["y"]),
    ]
    path = save(tmp_path / "m.onnx", nodes, [2], [weight("w", (2,))])
    tensors = open_graph(onnx, path)
    assert [tensors.is_constant(name) for name in ("w", "wc", "c", "r", "x", "y", "")] == [True] * 3 + [False] * 4


def test_each_layer_counts_for_the_first_part_that_names_its_module(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("MatMul", ["x", "a"], ["h"], name="vision.blocks.0.up/MatMul"),
        helper.make_node("MatMul", ["h", "b"], ["k"], name="head/MatMul"),
        helper.make_node("MatMul", ["k", "c"], ["y"], name="node_matmul_7"),
    ]
    path = save(tmp_path / "m.onnx", nodes, [1, 3, 4], [weight("a", (4, 8)), weight("b", (8, 2)), weight("c", (2, 5))])
    found = graph_workload(path, {"vision": ["vision", "vision.*"], "head": ["head"], "all": ["v*", "h*"]})
    assert found.parts == {"vision": (96, 32, 24, 1), "head": (48, 16, 6, 1), "": (30, 10, 15, 1)}
    totals = (sum(found.macs.values()), found.weights, found.activations, found.layers)
    assert tuple(map(sum, zip(*found.parts.values(), strict=True))) == totals
    assert graph_workload(path).parts == {}
    assert graph_workload(path, {"tail": ["tail"]}).parts == {}, "all that no part names says nothing"
