from pathlib import Path

import ml_dtypes
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.errors import DataError, GraphError, RecipeError
from vlatool.graph.layers import find_layers
from vlatool.quantize.float8 import Float8
from vlatool.quantize.floats.float8_qdq import Float8Writer, scale_of, to_float8
from vlatool.stage.base import Context

E4M3 = TensorProto.FLOAT8E4M3FN


@pytest.fixture(scope="module")
def eighth(float_bundle, tmp_path_factory) -> Bundle:
    """The tiny policy in float8; read only."""
    out = tmp_path_factory.mktemp("eighth") / "bundle"
    out.mkdir()
    return Float8(samples=8).run(float_bundle, out, Context()).bundle


def graph_of(bundle: Bundle):
    return onnx.load(bundle.path / "graphs/main.onnx").graph


def test_the_policy_runs_in_float8_near_float32(eighth, drift):
    assert Bundle.open(eighth.path) == eighth
    assert 0 < drift(eighth) < 0.15
    shares = eighth.manifest.graphs["main"].precision
    assert shares["float8"] > 0.7
    assert set(shares) == {"float8", "float32"}
    assert eighth.manifest.made_by["calibration"]["samples"] == 8


def test_every_pair_is_symmetric_e4m3(eighth):
    onnx.checker.check_model(onnx.load(eighth.path / "graphs/main.onnx"), full_check=True)
    graph = graph_of(eighth)
    constants = {tensor.name: tensor for tensor in graph.initializer}
    pairs = [node for node in graph.node if node.op_type in ("QuantizeLinear", "DequantizeLinear")]
    assert len(pairs) > 10
    for node in pairs:
        zero = constants[node.input[2]]
        assert zero.data_type == E4M3
        assert not any(zero.raw_data)
        assert list(zero.dims) == list(constants[node.input[1]].dims)
    weights = [constants[node.input[0]] for node in pairs if node.input[0] in constants]
    assert {tensor.data_type for tensor in weights} == {E4M3}
    layers = [node for node in graph.node if node.op_type in ("MatMul", "Gemm", "Conv")]
    quantized = [node for node in layers if all(name.endswith(".dq") for name in node.input[:2])]
    assert len(layers) - len(quantized) == 2  # attention multiplies activations with activations


def test_the_numbers_are_those_of_ml_dtypes(eighth, float_bundle):
    before = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph_of(float_bundle).initializer}
    after = {tensor.name: tensor for tensor in graph_of(eighth).initializer}
    name = next(name for name in after if name.endswith(".1.float8"))
    weight = before[name.removesuffix(".1.float8")]
    scales = numpy_helper.to_array(after[name.replace(".float8", ".scale")])
    np.testing.assert_allclose(scales, np.abs(weight).max(0) / 448, rtol=1e-6)
    codes = np.frombuffer(after[name].raw_data, ml_dtypes.float8_e4m3fn).reshape(weight.shape)
    assert np.abs(codes.astype(np.float32)).max() == 448
    np.testing.assert_allclose(codes.astype(np.float32) * scales, weight, rtol=1 / 16, atol=float(scales.max()) * 2**-9)


def test_what_is_too_large_saturates():
    codes, scale = to_float8(np.float32([[1e30, -1e30, 3.0]]), None, "w")
    assert codes.view(ml_dtypes.float8_e4m3fn).astype(np.float32).tolist() == [[448, -448, 0]]
    assert scale == pytest.approx(1e30 / 448)
    zeros, ones = to_float8(np.zeros((2, 3), np.float32), 1, "w")
    assert not zeros.any()
    assert ones.tolist() == [1, 1, 1]
    assert scale_of(1e-44) > 0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_weights_that_are_not_finite_are_named(bad):
    with pytest.raises(GraphError, match="The weight 'w' holds NaN or infinity"):
        to_float8(np.float32([[1, bad]]), 0, "w")


@pytest.mark.parametrize(
    "options", [{"per_channel": False}, {"attention": True}, {"ops": ("MatMul",)}, {"parts": ("head",)}], ids=str
)
def test_every_option_gives_a_policy_near_float(quantized, drift, options):
    bundle = quantized(Float8(samples=8, **options))
    assert 0 < drift(bundle) < 0.2
    share = bundle.manifest.graphs["main"].precision.get("float8", 0)
    assert (share == 1.0) == ("attention" in options)
    assert (share < 0.1) == ("parts" in options)


def test_excluded_layers_stay_in_float32(quantized):
    bundle = quantized(Float8(samples=8, exclude=("vision*",)))
    convolution = next(node for node in graph_of(bundle).node if node.op_type == "Conv")
    assert not any(name.endswith(".dq") for name in convolution.input)
    with pytest.raises(RecipeError, match="No node matches"):
        quantized(Float8(samples=8, include=("nothing",)))
    with pytest.raises(RecipeError, match="The operator 'Softmax' cannot be quantized"):
        Float8(ops=("Softmax",)).check(None, None)


def test_equal_inputs_give_equal_bytes(quantized, eighth):
    assert quantized(Float8(samples=8)).hash == eighth.hash


def test_an_opset_without_float8_is_refused():
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [2, 2]) for name in "xy")
    nodes = [helper.make_node("MatMul", ["x", "w"], ["y"], name="m")]
    graph = helper.make_graph(nodes, "g", [x], [y], [numpy_helper.from_array(np.eye(2, dtype=np.float32), "w")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
    with pytest.raises(GraphError, match="opset 18; float8 needs opset 19"):
        Float8Writer(model, find_layers(model, ("MatMul",)), {"x": 1.0}, True)


def test_without_calibration_data_it_says_so(float_bundle, copied, tmp_path: Path):
    Float8().check(None, None)
    assert Float8().inputs() == ()
    assert Float8(calibration=tmp_path / "c.npz").inputs() == (tmp_path / "c.npz",)
    bundle = copied(float_bundle)
    for path in (bundle.path / "data").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="carries no calibration data"):
        Float8().check(seal(bundle.path, bundle.manifest), None)


def test_a_rounding_that_falls_the_other_way_is_no_other_action(eighth):
    """A step of float8 is an eighth of a value: two threads add up in another order than one."""
    assert eighth.manifest.golden_tolerance == eighth.manifest.golden_chunk_tolerance == 0.06
