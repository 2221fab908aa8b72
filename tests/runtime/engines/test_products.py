"""Multiply-accumulates from the shapes that engines report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import onnxruntime
import pytest

from vlatool.runtime.convolution_weights import ConvolutionWeights, convolution_weights
from vlatool.runtime.engines._products import macs
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession

GRAPHS: dict[str, tuple[str, dict[str, tuple[int, ...]], int]] = {
    "rows": ("(float[2,5,8] x) => (y) { y = MatMul(x, w) }", {"w": (8, 3)}, 2 * 5 * 8 * 3),
    "transposed": ("(float[8,5] x) => (y) { y = Gemm<transA = 1>(x, w, b) }", {"w": (8, 3), "b": (3,)}, 5 * 8 * 3),
    "square": ("(float[6,6] x) => (y) { y = Gemm<transA = 1>(x, w) }", {"w": (6, 3)}, 6 * 6 * 3),
    "image": ("(float[1,3,9,9] x) => (y) { y = Conv(x, w) }", {"w": (8, 3, 2, 2)}, 8 * 8 * 8 * 3 * 4),
    "groups": ("(float[1,8,6,6] x) => (y) { y = Conv<group = 4>(x, w) }", {"w": (8, 2, 3, 3)}, 8 * 16 * 2 * 9),
    "depthwise": ("(float[1,8,6,6] x) => (y) { y = Conv<group = 8>(x, w) }", {"w": (8, 1, 3, 3)}, 8 * 16 * 9),
    "signal": ("(float[1,4,12] x) => (y) { y = Conv(x, w) }", {"w": (6, 4, 3)}, 6 * 10 * 4 * 3),
    "upwards": ("(float[1,4,5,5] x) => (y) { y = ConvTranspose(x, w) }", {"w": (4, 6, 2, 2)}, 4 * 25 * 6 * 4),
    **{name: (f"(float[1,3,9,9] x) => (y) {{ c = Conv(x, w)  y = {after} }}", {"w": (8, 3, 2, 2)}, 8 * 8 * 8 * 3 * 4)
       for name, after in (("activated", "Relu(c)"), ("leaky", "LeakyRelu<alpha = 0.1>(c)"), ("sigmoid", "Sigmoid(c)"),
                           ("added", "Add(c, c)"))},
    "scaled": ("(float[1,3,9,9] x) => (y) { c = Conv(x, w)  s = Mul(c, v)  y = Relu(s) }",
               {"w": (8, 3, 2, 2), "v": (8, 1, 1)}, 8 * 8 * 8 * 3 * 4),
    "residual": (
        "(float[1,3,9,9] x) => (y) { c = Conv<pads = [1,1,1,1]>(x, w)  r = Relu(c)"
        "  d = Conv<pads = [1,1,1,1]>(r, v)  a = Add(d, r)  y = Relu(a) }",
        {"w": (8, 3, 3, 3), "v": (8, 8, 3, 3)}, 81 * 8 * 9 * (3 + 8),
    ),
    "none": ("(float[4,4] x) => (y) { y = Softmax(x) }", {}, 0),
}  # fmt: skip


def written(folder: Path, text: str, weights: dict[str, tuple[int, ...]], named: str = "node") -> Path:
    signature, _, body = text.replace("(y)", "(float[?] y)").partition("{")
    signature = signature.replace("float[?] y", "float y")
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> g {signature}{{ {body.lstrip()}')
    model.graph.output[0].type.tensor_type.ClearField("shape")
    for number, (name, shape) in enumerate(weights.items()):
        value = np.random.default_rng(number).standard_normal(shape).astype(np.float32)
        model.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    model.graph.node[0].name = named
    onnx.save(model, folder / "graph.onnx")
    return folder / "graph.onnx"


@pytest.mark.parametrize("engine", [OrtCpuSession, OpenvinoSession])
@pytest.mark.parametrize(("text", "weights", "count"), GRAPHS.values(), ids=GRAPHS)
def test_engines_report_the_multiplications_of_a_graph(
    tmp_path: Path, engine: Any, text: str, weights: dict[str, tuple[int, ...]], count: int
) -> None:
    session = engine(written(tmp_path, text, weights), 1, traced=True)
    (name,), (port,) = session.takes, session.takes.values()
    for _ in range(2):
        session.run({name: np.ones(port.axes, np.float32)})
    runs = session.node_runs()
    assert sum(run.macs for run in runs) == count
    assert {run.precision for run in runs if run.macs} <= {"float32"}
    assert {run.provider for run in runs} == set(engine.targets())


@pytest.mark.parametrize(
    ("operator", "inputs", "outputs", "count"),
    [
        ("Gemm", [(5, 8), (3,)], [(5, 3)], 5 * 8 * 3),  # packed weights are not reported
        ("MatMulNBits", [(1, 7, 64), (1,)], [(1, 7, 10)], 7 * 64 * 10),
        ("LSTM", [(7, 2, 5)], [(7, 1, 2, 3), (1, 2, 3)], 7 * 2 * 4 * 3 * (5 + 3)),
        ("GRU", [(7, 2, 5)], [(1, 2, 3)], 7 * 2 * 3 * 3 * (5 + 3)),
        ("Attention", [(1, 4, 6, 8), (1, 4, 9, 8), (1, 4, 9, 16)], [(1, 4, 6, 16)], 4 * 6 * 9 * (8 + 16)),
        ("Attention", [(1, 6, 32), (1, 9, 32), (1, 9, 32)], [(1, 6, 32)], 6 * 9 * 64),
        ("Attention", [(1, 4, 1, 8), (1, 4, 1, 8), (1, 4, 1, 8)], [(1, 4, 1, 8), (1, 4, 9, 8)], 4 * 9 * 16),
        ("Einsum", [(2, 3), (3, 4)], [(2, 4)], None),
        ("TRTKernel_graph_main_1", [(2, 3)], [(2, 4)], None),
        ("OpenVINO-EP-subgraph_1", [(2, 3)], [(2, 4)], None),
        ("QLinearConv", [(1, 8, 8, 3), ()], [(1, 4, 4, 6)], None),
        ("Attention", [(1, 6, 32)], [(1, 6, 32)], None),
        ("MatMul", [], [], None),
        ("Softmax", [], [], 0),
    ],
)
def test_what_the_shapes_do_not_tell_is_not_guessed(operator: str, inputs: Any, outputs: Any, count: Any) -> None:
    assert macs(operator, inputs, outputs, {}, "") == count


def test_the_file_says_how_many_weights_a_convolution_has_and_the_longest_name_counts(tmp_path: Path) -> None:
    path = written(tmp_path, *GRAPHS["groups"][:2], named="stem/Conv")
    known = convolution_weights(path)
    assert known == convolution_weights(path.read_bytes()) == {"stem/Conv": (8, 18), "y": (8, 18)}
    shapes = [(1, 6, 6, 8), ()], [(1, 4, 4, 8)]
    others = {
        "stem": ConvolutionWeights(8, 1),
        "stem/Conv2": ConvolutionWeights(8, 2),
        "relu": ConvolutionWeights(8, 3),
    }
    assert macs("QLinearConv", *shapes, others, "relu_nchwc") == 8 * 16 * 3
    for another in ("relu_1_nchwc", "relu2", "stem/Conv_12"):
        assert macs("QLinearConv", *shapes, {"relu": others["relu"], **known}, another) is None, (
            "a number names another"
        )
    assert macs("QLinearConv", *shapes, {**known, **others}, "stem/Conv_token_0") == 8 * 16 * 18


def test_only_the_first_run_is_noted_and_nothing_stays_behind(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    session = OrtCpuSession(written(tmp_path, *GRAPHS["rows"][:2]), 1, traced=True)
    assert (session.node_runs(), len(list(tmp_path.glob("vlatool-trace-*")))) == ([], 1)
    x = np.ones((2, 5, 8), np.float32)
    first = session.run({"x": x})["y"]
    noted = session.node_runs()
    assert noted
    assert not list(tmp_path.glob("vlatool-trace-*"))
    np.testing.assert_array_equal(session.run({"x": x})["y"], first)
    assert session.node_runs() is noted


def test_a_trace_that_cannot_be_written_costs_no_inference(tmp_path: Path, monkeypatch) -> None:
    session = OrtCpuSession(written(tmp_path, *GRAPHS["rows"][:2]), 1, traced=True)
    monkeypatch.setattr(onnxruntime.InferenceSession, "end_profiling", lambda _: str(tmp_path / "absent.json"))
    assert session.run({"x": np.ones((2, 5, 8), np.float32)})["y"].shape == (2, 5, 3)
    assert session.node_runs() == []
