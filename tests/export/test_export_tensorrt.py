"""What TensorRT's parser takes: pairs around 0, float biases, scales on axis 0; the plan, and what is refused."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import helper, numpy_helper, parser

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.errors import GraphError, RecipeError, SpecError
from vlatool.export._tensorrt_operators import refuse_unsupported, support_list
from vlatool.export._tensorrt_plan import _range_of, ranges_from
from vlatool.export._tensorrt_qdq import TensorrtQdq
from vlatool.export.tensorrt import Tensorrt
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.stage.base import Context, Result

Arrays = dict[str, np.ndarray]


def planned(bundle: Bundle, folder: Path, **options: object) -> Result:
    (folder / "trt").mkdir(parents=True)
    return Tensorrt(**options).run(bundle, folder / "trt", Context())


def quantized(bundle: Bundle, folder: Path, **options: object) -> Bundle:
    (folder / "int8").mkdir(parents=True)
    return StaticInt8(**options).run(bundle, folder / "int8", Context()).bundle


@pytest.fixture(scope="module")
def made(float_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return planned(float_bundle, tmp_path_factory.mktemp("tensorrt"))


def pairs(model: onnx.ModelProto) -> tuple[list[onnx.NodeProto], Arrays]:
    held = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    return [node for node in model.graph.node if node.op_type in ("QuantizeLinear", "DequantizeLinear")], held


def check_pairs(path: Path) -> int:
    """Check what TensorRT's parser demands of every pair; return how many there are."""
    nodes, held = pairs(onnx.load(path))
    for node in nodes:
        zero = held[node.input[2]]
        assert zero.dtype == np.int8
        assert not zero.any()
        stored = held.get(node.input[0])
        assert stored is None or stored.dtype == np.int8, "no bias is quantized"
        axis = [item.i for item in node.attribute if item.name == "axis"]
        assert held[node.input[1]].size == 1 or axis == [0]
    return len(nodes)


def test_a_float32_bundle_is_planned_and_says_that_nothing_was_built(made: Result) -> None:
    plan = json.loads((made.bundle.path / "tensorrt/plan.json").read_text())
    graph = plan["graphs"]["main"]
    assert graph["sha256"] == {"../graphs/main.onnx": hash_file(made.bundle.path / "graphs/main.onnx")}
    assert plan["parser"]["tensorrt"] == "10.1"
    assert {tuple(each["min"]) for each in graph["shapes"].values()} == {
        tuple(each["max"]) for each in graph["shapes"].values()
    }
    assert any("tensorrt is not installed here: no engine was built or run" in text for text in made.messages)
    assert "tensorrt/build.sh" in made.bundle.manifest.files


def test_the_script_checks_the_graph_and_calls_trtexec(made: Result, tmp_path: Path) -> None:
    script = (made.bundle.path / "tensorrt/build.sh").read_text()
    assert subprocess.run(["sh", "-n"], input=script, text=True, check=False).returncode == 0
    assert "--stronglyTyped" in script
    assert "--memPoolSize=workspace:1024M" in script
    assert "Shapes=" not in script, "the shapes are fixed"


def test_the_program_refuses_another_graph_than_that_of_the_plan(made: Result, copied) -> None:
    """The check comes before tensorrt is imported, so it runs here."""
    bundle = copied(made.bundle)
    program = bundle.path / "tensorrt/build.py"
    ast.parse(program.read_text(), feature_version=(3, 8))

    def run() -> str:
        return subprocess.run([sys.executable, "-I", program], capture_output=True, text=True, check=False).stderr

    assert "tensorrt is not installed" in run()
    with (bundle.path / "graphs/main.onnx").open("ab") as stream:
        stream.write(b"\0")
    assert "graphs/main.onnx is not the file of the plan" in run()


def test_signed_int8_is_written_as_the_parser_wants_it(float_bundle: Bundle, tmp_path: Path) -> None:
    result = planned(quantized(float_bundle, tmp_path, layout="qdq", activations="int8"), tmp_path)
    assert check_pairs(result.bundle.path / "graphs/main.onnx") > 4
    assert not any("became int8" in text for text in result.messages)


def test_unsigned_activations_are_quantized_anew_and_the_cost_is_said(float_bundle: Bundle, tmp_path: Path) -> None:
    result = planned(quantized(float_bundle, tmp_path, layout="qdq"), tmp_path)
    assert check_pairs(result.bundle.path / "graphs/main.onnx") > 4
    assert any("uint8 activations became int8" in text for text in result.messages)


def test_operators_of_onnx_runtime_are_refused_by_name_with_the_command(int8_bundle: Bundle, tmp_path: Path) -> None:
    with pytest.raises(GraphError, match=r"operator (com\.microsoft\.\w+|MatMulInteger)") as caught:
        planned(int8_bundle, tmp_path)
    assert "--layout qdq --activations int8" in caught.value.fix


# ---- pairs


def graph_of(nodes: list[onnx.NodeProto], held: Arrays, shape: list[int], gives: list[int]) -> onnx.ModelProto:
    ends = [helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, s) for n, s in (("x", shape), ("y", gives))]
    stored = [numpy_helper.from_array(np.asarray(value), name) for name, value in held.items()]
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], stored)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)


def answer(model: onnx.ModelProto, shape: list[int]) -> np.ndarray:
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    feeds = {"x": np.random.default_rng(0).uniform(-1, 1, shape).astype("f4")}
    return onnxruntime.InferenceSession(model.SerializeToString(), options).run(None, feeds)[0]


RANDOM = np.random.default_rng(1)
CODES = RANDOM.integers(-127, 128, (4, 6)).astype(np.int8)
SCALES = RANDOM.uniform(0.01, 0.02, 6).astype("f4")


def layer(kind: str, held: Arrays, axis: int, **attributes: object) -> list[onnx.NodeProto]:
    bias = [helper.make_node("DequantizeLinear", ["b", "bs"], ["bd"], axis=0)] if "b" in held else []
    return [
        helper.make_node("QuantizeLinear", ["x", "s", "z"], ["q"], "x/quantize"),
        helper.make_node("DequantizeLinear", ["q", "s", "z"], ["d"], "x/dequantize"),
        helper.make_node("DequantizeLinear", ["w", "ws", "wz"], ["wd"], "w/dequantize", axis=axis),
        *bias,
        helper.make_node(kind, ["d", "wd", *(["bd"] if bias else [])], ["y"], "layer", **attributes),
    ]


def held_of(codes: np.ndarray, zero: np.ndarray, **more: np.ndarray) -> Arrays:
    return {"s": np.float32(0.01), "z": zero, "w": codes, "ws": SCALES, "wz": np.zeros(6, np.int8), **more}


CASES = {
    "MatMul, scales on axis 1": ("MatMul", held_of(CODES, np.int8(0)), 1, {}),
    "Gemm, transposed": ("Gemm", held_of(np.ascontiguousarray(CODES.T), np.int8(0)), 0, {"transB": 1}),
    "Gemm with a bias": (
        "Gemm", held_of(CODES, np.int8(0), b=RANDOM.integers(-9999, 9999, 6).astype("i4"), bs=SCALES * 0.01), 1, {}
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_weights_and_biases_keep_their_values(case: str) -> None:
    kind, held, axis, attributes = CASES[case]
    model = graph_of(layer(kind, held, axis, **attributes), held, [2, 4], [2, 6])
    wanted = answer(model, [2, 4])
    TensorrtQdq(model, "fix").write()
    onnx.checker.check_model(model, full_check=True)
    np.testing.assert_allclose(answer(model, [2, 4]), wanted, atol=1e-6)
    nodes, stored = pairs(model)
    assert all(stored[node.input[0]].dtype == np.int8 for node in nodes if node.input[0] in stored)
    assert [item.i for node in nodes for item in node.attribute if item.name == "axis"] == [0]


@pytest.mark.parametrize(
    ("zero", "low", "high"), [(0, 0.0, 2.55), (128, -1.28, 1.27), (200, -2.0, 0.55), (255, -2.55, 0)]
)
def test_a_uint8_range_becomes_one_around_zero(zero: int, low: float, high: float) -> None:
    held = held_of(CODES, np.uint8(zero))
    model = graph_of(layer("MatMul", held, 1), held, [2, 4], [2, 6])
    wanted = answer(model, [2, 4])
    writer = TensorrtQdq(model, "fix")
    writer.write()
    assert writer.requantized == ["x"]
    nodes, stored = pairs(model)
    scale = float(stored[nodes[0].input[1]])
    assert scale == pytest.approx(max(-low, high) / 127, rel=1e-5)
    got = answer(model, [2, 4])
    if zero == 128:
        np.testing.assert_allclose(got, wanted, atol=6 * scale * 0.02 * 127 / 2)


def computed_scale(nodes: list[onnx.NodeProto]) -> list[onnx.NodeProto]:
    nodes[0].input[1] = nodes[1].input[1] = "ss"
    return [helper.make_node("ReduceMax", ["x"], ["ss"], keepdims=0), *nodes]


def codes_moved(nodes: list[onnx.NodeProto]) -> list[onnx.NodeProto]:
    nodes[1].input[0] = "moved"
    return [nodes[0], helper.make_node("Identity", ["q"], ["moved"]), *nodes[1:]]


def other_scale(nodes: list[onnx.NodeProto]) -> list[onnx.NodeProto]:
    nodes[1].input[1] = "other"
    return nodes


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (computed_scale, "its scale or zero point is computed"),
        (codes_moved, "its codes are read by Identity"),
        (other_scale, "its codes are read with other scales"),
    ],
)
def test_pairs_that_cannot_be_written_so_are_refused(change, why: str) -> None:
    held = held_of(CODES, np.uint8(7), other=np.float32(0.5))
    model = graph_of(change(layer("MatMul", held, 1)), held, [2, 4], [2, 6])
    with pytest.raises(GraphError, match=why) as caught:
        TensorrtQdq(model, "the fix").write()
    assert caught.value.fix == "the fix"


def test_weights_that_are_not_around_zero_are_refused() -> None:
    held = held_of(CODES, np.int8(0)) | {"wz": np.full(6, 3, np.int8)}
    model = graph_of(layer("MatMul", held, 1), held, [2, 4], [2, 6])
    with pytest.raises(GraphError, match="its weights are not int8 around 0"):
        TensorrtQdq(model, "fix").write()


# ---- operators, types, shapes


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("d = Det(x) y = Identity(d)", "operator Det"),
        ("y = com.microsoft.FastGelu(x)", r"operator com\.microsoft\.FastGelu"),
        ("c = Cast<to=9>(x) d = Relu(x) i = Cast<to=6>(c) a = Softmax(x) y = Add(a, d)", ""),
        ("i = Cast<to=6>(x) t = Tanh(x) e = Cast<to=10>(i) s = CumSum(i, n) y = Add(x, t)", "CumSum of int32"),
        ("n2 = ReduceMax(k) a = Cast<to=7>(n2) y = CumSum(x, a)", "CumSum whose input 1 is computed"),
    ],
)
def test_each_operator_is_held_against_the_published_list(body: str, told: str) -> None:
    shape = "float[] y" if body.startswith("d = Det") else "float[2,2] y"
    head = '<ir_version: 10, opset_import: ["" : 20, "com.microsoft" : 1]>'
    model = parser.parse_model(f"{head} g (float[2,2] x, int64[1] k) => ({shape}) <int64 n = {{0}}> {{{body}}}")
    if not told:
        refuse_unsupported(model, "main", "fix")
        return
    with pytest.raises(GraphError, match=f"'main': {told}.*list for TensorRT 10.1"):
        refuse_unsupported(model, "main", "fix")


def test_the_list_says_where_it_is_from() -> None:
    known = support_list()
    assert known["source"].startswith("github:onnx/onnx-tensorrt ")
    assert known["operators"]["MatMulInteger"] == []
    assert "float32" in known["operators"]["MatMul"]


@pytest.mark.parametrize(
    "text", ["ids", "ids=1x8", "ids=1x8:1x4:1x2", "ids=1x8:1x8", "=1:1:1", "ids=0x8:1x8:1x8", "ids=a:b:c"]
)
def test_a_range_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(RecipeError, match="is not a range of shapes"):
        ranges_from((text,))


def test_a_free_axis_needs_a_range_and_a_fixed_one_has_none() -> None:
    ranges = ranges_from(("ids=1x8:1x16:1x48",))
    assert _range_of("ids", [1, "n"], ranges) == {"min": [1, 8], "opt": [1, 16], "max": [1, 48]}
    with pytest.raises(SpecError, match="free axes n") as caught:
        _range_of("x", [1, "n"], ranges)
    assert "--shapes x=1xn" in caught.value.fix
    with pytest.raises(SpecError, match=r"the graph has \[2, 'n'\]"):
        _range_of("ids", [2, "n"], ranges)


def test_a_range_of_an_input_that_is_not_there_is_refused(float_bundle: Bundle, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="names an input that no graph has"):
        planned(float_bundle, tmp_path, shapes=("nothing=1:1:1",))
