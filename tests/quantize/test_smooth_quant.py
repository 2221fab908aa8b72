import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnxruntime import InferenceSession

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph
from vlatool.errors import BundleError, DataError, GraphError, RecipeError
from vlatool.graph.files import load, save
from vlatool.graph.layers import find_layers
from vlatool.quantize.int8.smoothing_groups import find_groups
from vlatool.quantize.int8.smoothing_scales import PeakExcess, best_alpha, int8_loss, smooth_scales, weight_peaks
from vlatool.quantize.smooth_quant import SmoothQuant, _Writer
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.stage.build import build_stage

WIDTH = 6
RANDOM = 7


def report(bundle: Bundle) -> list[dict]:
    return json.loads((bundle.path / "reports/smooth_quant.json").read_text())["groups"]


def graph(nodes: list, constants: dict[str, np.ndarray], inputs: tuple[str, ...] = ("x",), opset: int = 20):
    """A model of those nodes: inputs (2, 3, WIDTH), output y."""
    made = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [2, 3, WIDTH]) for name in inputs],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)
    model = onnx.shape_inference.infer_shapes(model)
    onnx.checker.check_model(model, full_check=True)
    return model


def node(kind: str, inputs: str, output: str, **attributes):
    return helper.make_node(kind, inputs.split(), output.split(), name=f"{output.split()[0]}/{kind}", **attributes)


def constant(*shape: int, seed: int = RANDOM) -> np.ndarray:
    return np.random.default_rng([seed, *shape]).normal(size=shape).astype(np.float32)


def compute(model, inputs: tuple[str, ...]) -> np.ndarray:
    session = InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {name: constant(2, 3, WIDTH, seed=number) for number, name in enumerate(inputs)})[0]


W, V = constant(WIDTH, WIDTH, seed=1), constant(WIDTH, WIDTH, seed=2)
BIAS, SCALE = constant(WIDTH, seed=3), 1 + np.abs(constant(WIDTH, seed=4))
LAST = node("MatMul", "h v", "y")
FOLDED = {
    "layer norm": ([node("LayerNormalization", "x c b", "h"), LAST], {"c": SCALE, "b": BIAS}),
    "layer norm without bias": ([node("LayerNormalization", "x c", "h", axis=2), LAST], {"c": SCALE}),
    "rms weight": ([node("Mul", "x c", "h"), LAST], {"c": SCALE}),
    "division": ([node("Div", "x c", "h"), LAST], {"c": SCALE}),
    "linear, bias, relu": (
        [node("MatMul", "x w", "a"), node("Add", "b a", "r"), node("Relu", "r", "h"), LAST],
        {"w": W, "b": BIAS},
    ),
    "scalar bias and factor": (
        [node("MatMul", "x w", "a"), node("Sub", "a one", "r"), node("Mul", "half r", "h"), LAST],
        {"w": W, "one": np.ones(1, np.float32), "half": np.array(0.5, np.float32)},
    ),
    "gemm": (
        [node("Reshape", "x flat", "f"), node("Gemm", "f w b", "h", transB=1), node("Gemm", "h v b", "y")],
        {"flat": np.array([6, WIDTH]), "w": W, "b": BIAS},
    ),
    "gated": (
        [
            node("MatMul", "x w2", "a"),
            node("Split", "a", "u g", axis=-1, num_outputs=2),
            node("Sigmoid", "g", "s"),
            node("Mul", "s u", "h"),
            LAST,
        ],
        {"w2": constant(WIDTH, 2 * WIDTH)},
    ),
    "two branches": (
        [node("MatMul", "x w", "a"), node("Mul", "z c", "m"), node("Add", "a m", "h"), LAST],
        {"w": W, "c": SCALE},
    ),
    "moved": (
        [
            node("LayerNormalization", "x c b", "n"),
            node("Transpose", "n", "t", perm=[1, 0, 2]),
            node("Gather", "t first", "f", axis=0),
            node("Unsqueeze", "f zero", "k"),
            node("ReduceMean", "k one", "h", keepdims=0),
            LAST,
        ],
        {"c": SCALE, "b": BIAS, "first": np.array(0), "zero": np.array([0]), "one": np.array([1])},
    ),
    "shared constant": (
        [node("Mul", "x c", "h"), node("MatMul", "h v", "p"), node("Mul", "p c", "q"), node("MatMul", "q v", "y")],
        {"c": SCALE},
    ),
}
NOT_FOLDED = {
    "gelu": ([node("MatMul", "x w", "a"), node("Gelu", "a", "h"), LAST], {"w": W}),
    "another reader": (
        [node("Mul", "x c", "h"), node("MatMul", "h v", "p"), node("Add", "p h", "y")],
        {"c": SCALE},
    ),
    "another reader before": (
        [node("MatMul", "x w", "a"), node("Relu", "a", "h"), node("MatMul", "h v", "p"), node("Add", "p a", "y")],
        {"w": W},
    ),
    "input": ([node("MatMul", "x v", "y")], {}),
    "square": ([node("MatMul", "x w", "a"), node("Mul", "a a", "h"), LAST], {"w": W}),
    "mixed axes": ([node("Mul", "x c", "m"), node("Transpose", "m", "h", perm=[0, 2, 1]), node("MatMul", "h u", "y")],
                   {"c": SCALE, "u": constant(3, 4)}),
    "norm over two axes": ([node("LayerNormalization", "x c2", "h", axis=1), LAST], {"c2": constant(3, WIDTH)}),
}  # fmt: skip


def rewritten(nodes: list, constants: dict, inputs: tuple[str, ...]):
    """Scale every group with random scales; return the folded and the other groups, and outputs before and after."""
    read = {name for each in nodes for name in each.input}
    model = graph(nodes, {**constants, **({"v": V} if "v" in read else {})}, inputs)
    before = compute(model, inputs)
    groups = find_groups(model, find_layers(model, ("MatMul", "Gemm")))
    for number, group in enumerate(groups):
        size = 3 if group.layers[0].weight == "u" else WIDTH
        _Writer(model).apply(group, np.exp(constant(size, seed=10 + number)))
    onnx.checker.check_model(model, full_check=True)
    return groups, before, compute(model, inputs)


@pytest.mark.parametrize("name", FOLDED)
def test_scales_fold_into_constants_exactly(name):
    nodes, constants = FOLDED[name]
    inputs = ("x", "z") if name == "two branches" else ("x",)
    groups, before, after = rewritten(
        [onnx.NodeProto.FromString(n.SerializeToString()) for n in nodes], constants, inputs
    )
    assert next(group for group in groups if any(layer.weight == "v" for layer in group.layers)).edits
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NOT_FOLDED)
def test_what_cannot_be_folded_takes_a_mul(name):
    nodes, constants = NOT_FOLDED[name]
    groups, before, after = rewritten(
        [onnx.NodeProto.FromString(n.SerializeToString()) for n in nodes], constants, ("x",)
    )
    assert not groups[-1].edits
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-5)


def test_readers_of_one_activation_share_its_scale():
    nodes = [
        node("LayerNormalization", "x c b", "h"),
        node("MatMul", "h w", "q"),
        node("MatMul", "h v", "k"),
        node("Add", "q k", "y"),
    ]
    model = graph(nodes, {"c": SCALE, "b": BIAS, "w": W, "v": V})
    layers = find_layers(model, ("MatMul",))
    (group,) = find_groups(model, layers)
    assert [layer.weight for layer in group.layers] == ["w", "v"]
    (alone,) = find_groups(model, layers[:1])  # the other is excluded: folding would change what it computes
    assert not alone.edits


def test_the_scales_are_those_of_the_paper():
    x, w = np.array([1.0, 4.0, 100.0]), np.array([2.0, 2.0, 0.5])
    wanted = x**0.5 / w**0.5
    scales = smooth_scales(x, w, 0.5)
    np.testing.assert_allclose(scales / scales[0], wanted / wanted[0], rtol=1e-6)
    np.testing.assert_allclose(np.log(scales).sum(), 0, atol=1e-6)
    levelled = x / smooth_scales(x, w, 1.0)
    np.testing.assert_allclose(levelled, levelled[0], rtol=1e-6)


def test_channels_that_calibration_did_not_see_stay_in_bounds():
    scales = smooth_scales(np.array([0.0, 1.0, 2.0]), np.array([1.0, 0.0, 1.0]), 0.5)
    assert np.isfinite(scales).all()
    assert (scales > 0).all()
    np.testing.assert_array_equal(smooth_scales(np.zeros(3), np.ones(3), 0.5), np.ones(3))


def test_the_estimate_follows_the_measured_error():
    random = np.random.default_rng(0)
    x = random.normal(size=(4000, 32)) * np.where(np.arange(32) == 5, 40, 1)
    w = random.normal(size=(32, 16))
    peaks = np.abs(x).max(0)

    def measured(scales):
        smooth, scaled = x / scales, w * scales[:, None]
        step, steps = 2 * np.abs(smooth).max() / 255, np.abs(scaled).max(0) / 127
        got = (np.round(smooth / step) * step) @ (np.round(scaled / steps) * steps)
        return np.square(got - x @ w).sum() / len(x)

    for alpha in (0.0, 0.5, 1.0):
        scales = smooth_scales(peaks, weight_peaks([w]), alpha)
        assert int8_loss(peaks, [w], scales) == pytest.approx(measured(scales), rel=0.5)
    chosen, scales = best_alpha(peaks, [w])
    assert chosen is not None
    assert measured(scales) < 0.2 * measured(np.ones(32))


def test_ranges_that_differ_between_halves_hold_back():
    random = np.random.default_rng(0)
    peaks, w = np.exp(random.normal(size=64)), random.normal(size=(64, 16))
    bold, _ = best_alpha(peaks, [w])
    careful, _ = best_alpha(peaks, [w], PeakExcess.between(peaks, peaks * 0.6, 4))
    assert bold is not None
    assert careful is None or careful < bold
    assert PeakExcess.between(np.zeros(2), np.zeros(2), 1) == PeakExcess(0.0, 1.0)


@pytest.mark.parametrize("options", [{}, {"alpha": "auto"}, {"insert": True}], ids=str)
def test_the_policy_computes_the_same(quantized, drift, float_bundle, options):
    bundle = quantized(SmoothQuant(samples=8, **options))
    assert Bundle.open(bundle.path) == bundle
    assert drift(bundle) < 1e-5
    assert bundle.manifest.graphs["main"].precision == {"float32": 1.0}
    record = bundle.manifest.made_by
    assert record["options"] == {"samples": 8, **options}
    assert record["calibration"]["samples"] == 8
    how = {note["value"]: note["how"] for note in report(bundle)}
    assert list(how.values()).count("folded") >= 2
    assert ("inserted" in how.values()) == ("insert" in options)
    assert f"{list(how.values()).count('folded')} scales folded" in SmoothQuant().summarize(bundle)[0]


def test_int8_of_a_policy_with_outliers_gains(quantized, drift, float_bundle, copied, resealed):
    outliers = copied(float_bundle)
    path = outliers.path / "graphs/main.onnx"
    model = load(path)
    for group in find_groups(model, find_layers(model, ("MatMul", "Gemm"))):
        if group.edits:
            _Writer(model).apply(group, np.where(np.arange(16) == 3, 1 / 60, 1).astype(np.float32))
    path.unlink()
    save(model, path)
    outliers = resealed(outliers)
    assert drift(outliers) < 1e-5
    plain = drift(quantized(StaticInt8(), outliers))
    for alpha in ("0.5", "auto"):
        smooth = quantized(SmoothQuant(alpha=alpha), outliers)
        assert drift(quantized(StaticInt8(), smooth)) < 0.5 * plain


def test_only_chosen_layers_are_smoothed(quantized, drift):
    bundle = quantized(SmoothQuant(samples=8, include=("blocks.0.mlp*",)))
    assert {name.split("/")[0] for note in report(bundle) for name in note["layers"]} <= {
        "blocks.0.mlp.1",
        "blocks.0.mlp.3",
    }
    assert drift(bundle) < 1e-5
    calm = quantized(SmoothQuant(samples=8, outliers=1000))
    assert {note["why"] for note in report(calm)} == {"it has no outlier channels"}
    with pytest.raises(RecipeError, match="No node matches"):
        quantized(SmoothQuant(samples=8, exclude=("nothing",)))


def test_equal_inputs_give_equal_bytes(quantized):
    first, second = (quantized(SmoothQuant(samples=8, alpha="auto")) for _ in range(2))
    assert first.hash == second.hash


@pytest.mark.parametrize("alpha", ["1.5", "much", -0.1, "nan"])
def test_impossible_alphas_are_refused(alpha):
    with pytest.raises(RecipeError, match="must be a number from 0 to 1, or auto"):
        build_stage("quantize.smooth_quant", {"alpha": alpha})


def test_alpha_may_be_a_number_in_a_recipe():
    assert build_stage("quantize.smooth_quant", {"alpha": 0.25}) == SmoothQuant(alpha="0.25")


def test_what_it_needs(float_bundle, copied, tmp_path: Path):
    SmoothQuant().check(None, None)
    assert SmoothQuant(calibration=tmp_path / "c.npz").inputs() == (tmp_path / "c.npz",)
    narrow = Graph("graphs/main.onnx", {}, 20, "bfloat16")
    manifest = type(float_bundle.manifest)(**{**vars(float_bundle.manifest), "graphs": {"main": narrow}})
    with pytest.raises(BundleError, match="bfloat16"):
        SmoothQuant().check(Bundle(float_bundle.path, manifest), None)
    bare = copied(float_bundle)
    for path in (bare.path / "data").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="carries no calibration data"):
        SmoothQuant().check(seal(bare.path, bare.manifest), None)


def test_a_changed_action_is_refused(quantized, monkeypatch):
    monkeypatch.setattr(_Writer, "_multiply", lambda *_: None)
    monkeypatch.setattr("vlatool.quantize.smooth_quant.MAX_CHANGE", -1.0)
    with pytest.raises(GraphError, match="changed the golden action"):
        quantized(SmoothQuant(samples=8))
