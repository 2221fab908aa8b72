"""Products of matrices in a row: compiled in a process of their own, for OpenVINO crashes on some."""

import subprocess
import sys

import numpy as np
import onnx
import pytest
from _full import small_or_full
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from vlatool.runtime.engines._sequences import joins_a_sequence
from vlatool.runtime.engines.openvino import OpenvinoSession

openvino = pytest.importorskip("openvino")
OPEN = """
import sys
from pathlib import Path
from vlatool.runtime.engines.openvino import OpenvinoSession
for path in sys.argv[1:]:
    for threads in (1, 2):
        print(path, threads, file=sys.stderr, flush=True)
        OpenvinoSession(Path(path), threads)
"""
MODELS = ({}, {"between": "Relu"}, {"products": "MatMul"}, {"turns": 5})


def perceptron(path, *, turns=2, residual=True, shape=(1, 16), products="Gemm", between="Gelu"):
    """Write Linear, GELU, Linear in turns, each time added to what it reads; return the path."""
    random = np.random.default_rng(0)
    weights, nodes, value = {}, [], "x"
    for name, size in (("w0", (16, 32)), ("b0", 32), ("w1", (32, 16)), ("b1", 16)):
        weights[name] = (random.normal(size=size) / 4).astype(np.float32)

    def node(kind, *inputs):
        name = f"v{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [name], name=name))
        return name

    for _ in range(turns):
        inner = value
        for number in range(2):
            if products == "Gemm":
                inner = node("Gemm", inner, f"w{number}", f"b{number}")
            else:
                inner = node("Add", node("MatMul", inner, f"w{number}"), f"b{number}")
            if number == 0:
                inner = node(between, inner)
        value = node("Add", value, inner) if residual else inner
    value = node("Tanh", value)
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("x", value)]
    tensors = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    graph = helper.make_graph(nodes, "perceptron", ends[:1], ends[1:], tensors)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), str(path))
    return path


@pytest.mark.parametrize("models", small_or_full([MODELS], [(model,) for model in MODELS]), ids=str)
def test_residual_products_of_matrices_do_not_end_the_process(models, tmp_path):
    paths = [perceptron(tmp_path / f"{number}.onnx", **options) for number, options in enumerate(models)]
    done = subprocess.run([sys.executable, "-c", OPEN, *map(str, paths)], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr[-300:]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, True),
        ({"turns": 1}, True),
        ({"products": "MatMul"}, True),
        ({"residual": False}, False),
        ({"shape": (1, 4, 16), "products": "MatMul"}, False),
    ],
    ids=str,
)
def test_what_joins_a_sequence_of_matrices_is_found(options, expected, tmp_path):
    path = perceptron(tmp_path / "model.onnx", **options)
    assert joins_a_sequence(openvino.Core().read_model(str(path))) is expected


def test_it_computes_what_is_written(tmp_path):
    path = perceptron(tmp_path / "model.onnx", turns=5)
    x = np.random.default_rng(1).normal(size=(1, 16)).astype(np.float32)
    (wanted,) = ReferenceEvaluator(str(path)).run(None, {"x": x})
    (got,) = OpenvinoSession(path, 1).run({"x": x}).values()
    np.testing.assert_allclose(got, wanted, atol=1e-5)
