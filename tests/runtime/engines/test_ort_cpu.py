"""The CPU engine: bound buffers give what a plain run gives, and mistakes are named."""

from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.errors import GraphError
from vlatool.runtime.engines.ort_cpu import OrtCpuSession


def _graph(path: Path, text: str) -> Path:
    onnx.save(onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}'), str(path))
    return path


SUM = "g (float[1,3] x, int64[2] n) => (float[1,3] y, int64[2] m) { y = Add(x, x)  m = Add(n, n) }"


@pytest.fixture
def session(tmp_path: Path) -> OrtCpuSession:
    return OrtCpuSession(_graph(tmp_path / "sum.onnx", SUM), threads=1)


def _feeds(value: float) -> dict[str, np.ndarray]:
    return {"x": np.full((1, 3), value, np.float32), "n": np.array([1, int(value)], np.int64)}


def test_a_small_static_graph_runs_through_bound_buffers_and_results_do_not_change_later(
    session: OrtCpuSession,
) -> None:
    assert session._bound is not None
    first = session.run(_feeds(2))
    second = session.run(_feeds(5))
    np.testing.assert_array_equal(first["y"], np.full((1, 3), 4, np.float32))
    np.testing.assert_array_equal(second["y"], np.full((1, 3), 10, np.float32))
    np.testing.assert_array_equal(first["m"], [2, 4])


def test_feeds_are_read_at_the_call_and_may_be_strided(session: OrtCpuSession) -> None:
    feeds = _feeds(0)
    feeds["x"] = np.arange(6, dtype=np.float32).reshape(1, 6)[:, ::2]
    np.testing.assert_array_equal(session.run(feeds)["y"], [[0, 4, 8]])
    feeds["x"] = feeds["x"].copy()
    feeds["x"][0, 0] = 7
    np.testing.assert_array_equal(session.run(feeds)["y"], [[14, 4, 8]])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("x", np.zeros((3,), np.float32)),
        ("x", np.zeros((1, 1), np.float32)),
        ("x", np.zeros((1, 3), np.float64)),
        ("x", None),
        ("extra", np.zeros(1, np.float32)),
    ],
)
def test_a_feed_that_does_not_fit_is_named(session: OrtCpuSession, name: str, value: object) -> None:
    with pytest.raises(GraphError, match=rf"ONNX Runtime failed in sum.*(\b{name}|double)"):
        session.run({**_feeds(1), name: value})
    np.testing.assert_array_equal(session.run(_feeds(1))["y"], [[2, 2, 2]])


def test_a_missing_feed_is_named(session: OrtCpuSession) -> None:
    with pytest.raises(GraphError, match="n"):
        session.run({"x": np.zeros((1, 3), np.float32)})


@pytest.mark.parametrize(
    "text",
    [
        "g (float[B,3] x) => (float[B,3] y) { y = Add(x, x) }",
        "g (float[1,70000] x) => (float[1,70000] y) { y = Add(x, x) }",
        "g (float[1,40000] x) => (float[1,40000] y) { y = Add(x, x) }",
        "g (bfloat16[1,3] x) => (float[1,3] y) { y = Cast<to = 1>(x) }",
    ],
    ids=["dynamic", "one large tensor", "large together", "no numpy type"],
)
def test_other_graphs_run_without_buffers(tmp_path: Path, text: str) -> None:
    session = OrtCpuSession(_graph(tmp_path / "other.onnx", text), threads=1)
    assert session._bound is None
    width = 3 if "3]" in text else int(text.split("1,")[1].split("]")[0])
    if "bfloat16" not in text:
        assert session.run({"x": np.ones((1, width), np.float32)})["y"].sum() == 2 * width


def test_a_file_that_is_no_graph_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.onnx"
    path.write_bytes(b"not a model")
    with pytest.raises(GraphError, match=r"ONNX Runtime .* refuses"):
        OrtCpuSession(path)


def _float8_of_relu(path: Path, dtype: int) -> Path:
    scale, zero = numpy_helper.from_array(np.float32(0.5), "s"), helper.make_tensor("z", dtype, [], [0.0])
    nodes = [
        helper.make_node("Relu", ["x"], ["r"]),
        helper.make_node("QuantizeLinear", ["r", "s", "z"], ["q"]),
        helper.make_node("DequantizeLinear", ["q", "s", "z"], ["y"]),
    ]
    ports = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3])] for name in ("x", "y")]
    graph = helper.make_graph(nodes, "g", *ports, [scale, zero])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), str(path))
    return path


@pytest.mark.parametrize("dtype", [TensorProto.FLOAT8E4M3FN, TensorProto.FLOAT8E5M2])
@pytest.mark.parametrize("as_bytes", [False, True])
def test_a_relu_before_a_float8_quantizer_stays(tmp_path: Path, dtype: int, as_bytes: bool) -> None:
    path = _float8_of_relu(tmp_path / "relu.onnx", dtype)
    session = OrtCpuSession(path, 1, opened=path.read_bytes() if as_bytes else None)
    given = session.run({"x": np.array([[-2, 0, 2]], np.float32)})
    np.testing.assert_array_equal(given["y"], [[0, 0, 2]])
