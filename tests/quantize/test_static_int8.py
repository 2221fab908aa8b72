from pathlib import Path

import numpy as np
import onnx
import pytest

from vlatool.bundle import Bundle, seal
from vlatool.data import recorded_observations
from vlatool.errors import DataError, RecipeError
from vlatool.quantize.static_int8 import StaticInt8, record_feeds
from vlatool.stage import build_stage


@pytest.fixture
def uncalibrated(float_bundle, copied) -> Bundle:
    """The float bundle without recorded data."""
    bundle = copied(float_bundle)
    for path in (bundle.path / "data").iterdir():
        path.unlink()
    return seal(bundle.path, bundle.manifest)


def test_the_policy_runs_in_int8_and_stays_near_float(int8_bundle, drift):
    assert Bundle.open(int8_bundle.path) == int8_bundle
    assert 0 < drift(int8_bundle) < 0.08


def test_convolution_and_products_with_weights_are_int8(int8_bundle, operators):
    counts = operators(int8_bundle)
    assert counts["MatMulIntegerToFloat"] >= 5
    assert counts["Conv"] == 1
    assert counts["MatMul"] == 2  # attention multiplies activations with activations
    shares = int8_bundle.manifest.graphs["main"].precision
    assert shares["int8"] > 0.7
    assert sum(shares.values()) == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("method", ["entropy", "percentile"])
def test_other_methods_of_calibration(quantized, drift, method):
    assert 0 < drift(quantized(StaticInt8(method=method, samples=8))) < 0.15


def test_the_percentile_cuts_ranges(quantized, drift):
    wide = quantized(StaticInt8(method="percentile", percentile=99.99, samples=8))
    narrow = quantized(StaticInt8(method="percentile", percentile=60, samples=8))
    assert drift(narrow) > drift(wide)


def test_both_layouts_compute_the_same_numbers(quantized, drift, int8_bundle, operators):
    standard = quantized(StaticInt8(layout="qdq"))
    assert drift(standard, int8_bundle) < 0.01
    model = onnx.load(standard.path / "graphs/main.onnx")
    assert {node.domain for node in model.graph.node} <= {"", "ai.onnx"}
    assert "MatMulIntegerToFloat" not in operators(standard)
    assert standard.manifest.graphs["main"].precision == int8_bundle.manifest.graphs["main"].precision


@pytest.mark.parametrize(
    "options",
    [
        {"activations": "int8"},
        {"per_channel": False},
        {"reduce_range": True},
        {"quantize_outputs": True},
        {"layout": "qdq", "activations": "int8"},
        {"ops": ("MatMul",)},
    ],
    ids=str,
)
def test_every_option_gives_a_policy_near_float(quantized, drift, options):
    bundle = quantized(StaticInt8(samples=8, **options))
    assert 0 < drift(bundle) < 0.15
    wanted = {name: list(value) if isinstance(value, tuple) else value for name, value in options.items()}
    assert bundle.manifest.made_by["options"] == {"samples": 8, **wanted}


def test_activations_have_the_asked_type(quantized):
    for activations, data_type in (("uint8", onnx.TensorProto.UINT8), ("int8", onnx.TensorProto.INT8)):
        bundle = quantized(StaticInt8(samples=4, activations=activations))
        graph = onnx.load(bundle.path / "graphs/main.onnx").graph
        zero_points = {tensor.name: tensor for tensor in graph.initializer}
        quantizers = [node for node in graph.node if node.op_type == "QuantizeLinear"]
        assert quantizers
        assert {zero_points[node.input[2]].data_type for node in quantizers} == {data_type}


def test_equal_inputs_give_equal_bytes(quantized, int8_bundle):
    assert quantized(StaticInt8()).hash == int8_bundle.hash


def test_excluded_convolutions_stay_in_float(quantized, float_bundle):
    graph = onnx.load(float_bundle.path / "graphs/main.onnx").graph
    convolution = next(node.name for node in graph.node if node.op_type == "Conv")
    bundle = quantized(StaticInt8(samples=4, exclude=(convolution,)))
    assert bundle.manifest.graphs["main"].precision["float32"] > 0.2
    only = quantized(StaticInt8(samples=4, include=(convolution,)))
    assert 0 < only.manifest.graphs["main"].precision["int8"] < 0.8


def test_a_glob_that_matches_no_node_is_a_typing_error(quantized):
    with pytest.raises(RecipeError, match="No MatMul/Gemm/Conv node matches 'no_such_node'"):
        quantized(StaticInt8(samples=4, exclude=("no_such_node",)))


def test_without_calibration_data_the_other_method_is_named(uncalibrated, quantized):
    with pytest.raises(DataError, match="carries no calibration data") as caught:
        StaticInt8().check(uncalibrated, None)
    assert "quantize.dynamic_int8" in caught.value.fix
    with pytest.raises(DataError):
        quantized(StaticInt8(), uncalibrated)


def test_calibration_data_may_be_given(uncalibrated, quantized, drift, policy_template):
    stage = StaticInt8(calibration=policy_template / "calibration.npz")
    assert stage.inputs() == (policy_template / "calibration.npz",)
    stage.check(uncalibrated, None)
    assert drift(quantized(stage, uncalibrated)) < 0.08


def test_calibration_data_that_does_not_fit_is_named(float_bundle, tmp_path: Path):
    np.savez(tmp_path / "c.npz", image=np.zeros((3, 8, 8, 3), np.uint8))
    with pytest.raises(DataError, match="has no 'proprio'"):
        StaticInt8(calibration=tmp_path / "c.npz").check(float_bundle, None)


def test_feeds_are_recorded_as_the_graph_sees_them(float_bundle):
    observations = recorded_observations(float_bundle, 3)
    feeds = record_feeds(float_bundle, observations)
    assert [len(found) for found in feeds.values()] == [3]
    first = feeds["main"][0]
    assert {name: (value.shape, str(value.dtype)) for name, value in first.items()} == {
        "image": ((1, 8, 8, 3), "uint8"),
        "proprio": ((1, 3), "float32"),
        "instruction": ((1, 4), "int64"),
    }
    wanted = (observations[0]["proprio"] - [0.1, -0.2, 0.5]) / [0.5, 0.25, 2.0]
    np.testing.assert_allclose(first["proprio"][0], wanted, rtol=1e-5)


@pytest.mark.parametrize("options", [{"samples": 0}, {"percentile": 50}, {"method": "mse"}, {"layout": "tensorrt"}])
def test_impossible_options_are_refused(options):
    with pytest.raises(RecipeError, match=next(iter(options))):
        build_stage("quantize.static_int8", options)


def test_without_a_source_there_is_nothing_to_check():
    StaticInt8().check(None, None)
    assert StaticInt8().inputs() == ()
