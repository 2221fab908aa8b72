import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from _arithmetic import computes_bfloat16, exact, full_range_or_less

from vlatool.bundle.bundle import Bundle, seal
from vlatool.errors import DataError, GraphError, MissingExtra, RecipeError
from vlatool.quantize.bfloat16 import Bfloat16
from vlatool.quantize.int8 import convolutions
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.stage.build import build_stage


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


@pytest.mark.parametrize("method", ["entropy", "percentile", "mse"])
def test_other_methods_of_calibration(quantized, drift, method):
    assert 0 < drift(quantized(StaticInt8(method=method, samples=8))) < 0.15


def test_the_percentile_cuts_ranges(quantized, drift):
    wide = quantized(StaticInt8(method="percentile", percentile=99.99, samples=8))
    narrow = quantized(StaticInt8(method="percentile", percentile=60, samples=8))
    assert drift(narrow) > drift(wide)


def test_both_layouts_compute_the_same_numbers(quantized, drift, int8_bundle, operators):
    """But for the frame: it is quantized after its normalisation in one, and is the pixels that it is in the other."""
    standard = quantized(StaticInt8(layout="qdq"))
    assert drift(standard, int8_bundle) < 0.02
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
        {"layout": "qdq", "activations": "int8"},
        {"ops": ("MatMul",)},
        {"ops": ("Gemm",)},
        {"attention": True},
        {"elementwise": True},
        {"layout": "openvino"},
        {"layout": "openvino", "attention": True},
        {"layout": "openvino", "compute": "bfloat16"},
    ],
    ids=str,
)
def test_every_option_gives_a_policy_near_float(quantized, drift, options):
    if options.get("compute") == "bfloat16" and not computes_bfloat16():
        with pytest.raises(GraphError, match=r"OpenVINO computes .* in f32 on this CPU; wanted bf16"):
            quantized(StaticInt8(samples=8, **options))
        return
    options = options | (full_range_or_less() if options.get("layout") == "openvino" else {})
    bundle = quantized(StaticInt8(samples=8, **options))
    assert 0 < drift(bundle) < 0.15
    wanted = {name: list(value) if isinstance(value, tuple) else value for name, value in options.items()}
    assert bundle.manifest.made_by["options"] == {"samples": 8, **wanted}


def test_attention_is_multiplied_in_integers_and_moved_in_bytes(quantized, operators):
    """Keys and values have 7 bits and a sign: exact on every processor, and twice as fast as uint8 on x86."""
    bundle = quantized(StaticInt8(samples=8, attention=True))
    counts = operators(bundle)
    assert "MatMul" not in counts
    graph = onnx.load(bundle.path / "graphs/main.onnx").graph
    constants = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    products = [
        node for node in graph.node if node.op_type == "MatMulIntegerToFloat" and node.input[1] not in constants
    ]
    assert len(products) == 2
    assert {constants[node.input[4]].dtype.name for node in products} == {"uint8"}
    assert {constants[node.input[5]].dtype.name for node in products} == {"int8"}
    quantized_values = {node.output[0] for node in graph.node if node.op_type == "QuantizeLinear"}
    moved = [node for node in graph.node if node.op_type == "Transpose" and node.input[0] not in quantized_values]
    assert len(moved) < counts["Transpose"], "most transpositions move bytes"


def test_a_frame_reaches_its_convolution_as_pixels(quantized):
    graph = onnx.load(quantized(StaticInt8(samples=8)).path / "graphs/main.onnx").graph
    first = graph.node[0]
    assert (first.op_type, first.input[0]) == ("Transpose", "image")
    assert not [node for node in graph.node if node.op_type == "Cast" and node.input[0] == "image"]


def test_activations_have_the_asked_type(quantized):
    for activations, data_type in (("uint8", onnx.TensorProto.UINT8), ("int8", onnx.TensorProto.INT8)):
        bundle = quantized(StaticInt8(samples=8, activations=activations))
        graph = onnx.load(bundle.path / "graphs/main.onnx").graph
        zero_points = {tensor.name: tensor for tensor in graph.initializer}
        quantizers = [node for node in graph.node if node.op_type == "QuantizeLinear"]
        assert quantizers
        assert {zero_points[node.input[2]].data_type for node in quantizers} == {data_type}


def test_equal_inputs_give_equal_bytes(quantized, int8_bundle):
    assert quantized(StaticInt8()).hash == int8_bundle.hash


def test_excluded_convolutions_stay_in_float(quantized):
    bundle = quantized(StaticInt8(samples=8, exclude=("vision/Conv",)))
    assert bundle.manifest.graphs["main"].precision["float32"] > 0.2
    only = quantized(StaticInt8(samples=8, include=("vision",)))
    assert 0 < only.manifest.graphs["main"].precision["int8"] < 0.8


def test_parts_are_those_of_the_policy(quantized, operators):
    bundle = quantized(StaticInt8(samples=8, parts=("head",)))
    assert operators(bundle)["MatMulIntegerToFloat"] == 1
    with pytest.raises(RecipeError, match="no part 'haed'; did you mean 'head'"):
        quantized(StaticInt8(samples=8, parts=("haed",)))


def test_only_gemm_is_quantized_when_only_gemm_is_asked_for(quantized, operators):
    assert operators(quantized(StaticInt8(samples=8, ops=("Gemm",))))["MatMulIntegerToFloat"] == 2  # state and head


def test_the_plan_knows_its_layers_before_the_work(float_bundle):
    for stage, count in ((StaticInt8(), 8), (StaticInt8(attention=True), 10)):
        layers, _ = stage.plan(float_bundle)
        assert sum(map(len, layers.values())) == count


def test_a_glob_that_matches_no_node_is_a_typing_error(quantized):
    with pytest.raises(RecipeError, match=r"No node matches 'visoin'; known: .*vision/Conv"):
        quantized(StaticInt8(exclude=("visoin",)))


def test_openvino_is_in_the_key_and_the_record_only_where_it_runs(quantized, float_bundle, monkeypatch):
    from vlatool.stage import base

    own, other = StaticInt8(samples=8, layout="openvino"), StaticInt8(samples=8, layout="qdq")
    assert "openvino" in quantized(own).manifest.made_by["versions"]
    assert "openvino" not in quantized(other).manifest.made_by["versions"]
    if computes_bfloat16():
        assert "openvino" in quantized(Bfloat16()).manifest.made_by["versions"]
    before = [each.key("x") for each in (own, other, Bfloat16())]
    real = base.installed_version
    monkeypatch.setattr(base, "installed_version", lambda name: "9" if name == "openvino" else real(name))
    assert [a == b for a, b in zip(before, (each.key("x") for each in (own, other, Bfloat16())), strict=True)] == [
        False,
        True,
        False,
    ]


def test_without_openvino_the_other_layouts_work(quantized, monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    for refused in (StaticInt8(layout="openvino"), Bfloat16()):
        with pytest.raises(MissingExtra, match="openvino") as caught:
            refused.check(None, None)
        assert caught.value.fix == "pip install 'vlatool[openvino]'"
    assert quantized(StaticInt8(samples=8, layout="qdq")).manifest.engine == ""


def test_openvino_computes_what_the_int8_graph_says(quantized):
    made = quantized(StaticInt8(layout="openvino", **full_range_or_less()))
    assert made.manifest.findings == ()
    assert load(made.path, threads=1).golden_error < 0.045


def test_where_openvino_saturates_the_stage_says_so_and_the_bundle_is_refused(quantized):
    """Exact or not, as the probe says."""
    made = quantized(StaticInt8(layout="openvino"))
    assert [each["name"] for each in made.manifest.findings] == ([] if exact("openvino") else ["engine-difference"])
    if not exact("openvino"):
        assert "Its int8 products are saturating" in made.manifest.findings[0]["message"]
        assert "--reduce-range" in made.manifest.findings[0]["message"]
        with pytest.raises(GraphError, match="was found to be wrong when it was made"):
            load(made.path, threads=1)


def test_convolutions_change_no_more_than_the_rounding(quantized, drift, operators, monkeypatch):
    monkeypatch.setattr(convolutions, "MIN_ROWS", 4)
    options = {"layout": "openvino", "samples": 8, **full_range_or_less()}
    plain = quantized(StaticInt8(**options, activations="uint8"))
    written = quantized(StaticInt8(**options, convolutions=True))
    assert operators(written)["Conv"] > operators(plain)["Conv"]
    assert operators(written).get("MatMul", 0) < operators(plain)["MatMul"]
    assert drift(written, plain) < max(0.5 * drift(plain), 0.01)
    assert drift(written) < 1.5 * drift(plain)


def test_convolutions_are_full_range_or_less():
    with pytest.raises(RecipeError, match="The layout ort does not use convolutions") as caught:
        StaticInt8(convolutions=True).check(None, None)
    assert caught.value.fix == "use layout openvino"


def test_other_dtypes_need_the_layout_that_computes_in_them():
    with pytest.raises(RecipeError, match="The layout ort does not compute in bfloat16") as caught:
        StaticInt8(compute="bfloat16").check(None, None)
    assert caught.value.fix == "use layout openvino"


def test_nodes_without_names_are_told_apart(quantized, float_bundle, copied, resealed, drift, int8_bundle, operators):
    """Some exporters leave names empty."""
    bundle = copied(float_bundle)
    model = onnx.load(bundle.path / "graphs/main.onnx")
    for node in model.graph.node:
        node.name = ""
    onnx.save(model, bundle.path / "graphs/main.onnx")
    made = quantized(StaticInt8(), resealed(bundle))
    assert operators(made) == operators(int8_bundle)
    assert drift(made, int8_bundle) < 1e-6


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


@pytest.mark.parametrize("options", [{"samples": 0}, {"percentile": 50}, {"method": "median"}, {"layout": "tensorrt"}])
def test_impossible_options_are_refused(options):
    with pytest.raises(RecipeError, match=next(iter(options))):
        build_stage("quantize.static_int8", options)


def test_without_a_source_there_is_nothing_to_check():
    StaticInt8().check(None, None)
    assert StaticInt8().inputs() == ()
