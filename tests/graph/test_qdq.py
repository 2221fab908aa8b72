"""Quantization pairs in a graph: what ONNX Runtime computes with its optimizations off is what numpy computes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnx
import onnxruntime
import pytest
from _arithmetic import exact
from _full import small_or_full
from _qdq_reference import (
    IMAGE,
    OPS,
    STYLES,
    X,
    close,
    conv,
    graph,
    kinds,
    quantized,
    rounded,
    rounded_weight,
    run,
    weight,
)

from vlatool.errors import GraphError
from vlatool.graph.layers import Layer, Style, check_weights, find_layers
from vlatool.graph.nodes import read_names
from vlatool.graph.qdq import quantize_weight
from vlatool.quantize.int8.integer_matmul import use_integer_matmul
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.weight_pairs import weights_fit


@pytest.mark.parametrize("style", STYLES.values(), ids=STYLES)
class TestLayers:
    """Each kind of layer in each style."""

    def test_matmul(self, style: Style) -> None:
        w = weight(6, 5)
        model, layers = quantized(graph("(float[4,6] x) => (float[4,5] y) { y = MatMul(x, w) }", w=w), style, {})
        assert layers == [Layer("MatMul_0", "MatMul", ("x",), "w", 1, "", "y")]
        close(run(model, x=X)["y"], rounded(X, style) @ rounded_weight(w, style, 1))

    @pytest.mark.parametrize("transposed", [0, 1])
    def test_gemm(self, style: Style, transposed: int) -> None:
        w, b = weight(6, 5), weight(5, seed=2)
        text = f"(float[4,6] x) => (float[4,5] y) {{ y = Gemm<transB={transposed}>(x, w, b) }}"
        stored = np.ascontiguousarray(w.T) if transposed else w
        model, layers = quantized(graph(text, w=stored, b=b), style, {})
        assert layers[0].axis == 1 - transposed
        close(run(model, x=X)["y"], rounded(X, style) @ rounded_weight(w, style, 1) + b)

    def test_a_weight_of_three_axes(self, style: Style) -> None:
        w, x = weight(2, 6, 5), weight(2, 4, 6, seed=3)
        model, _ = quantized(graph("(float[2,4,6] x) => (float[2,4,5] y) { y = MatMul(x, w) }", w=w), style, {})
        close(run(model, x=x)["y"], rounded(x, style) @ rounded_weight(w, style, 2))

    def test_a_convolution_with_relu(self, style: Style) -> None:
        w, b = weight(5, 3, 4, 4, scale=0.1), weight(5, seed=2)
        text = """(float[1,3,8,8] x) => (float[1,5,4] z)
            { c = Conv<strides=[4,4]>(x, w, b)  y = Relu(c)  z = Reshape(y, to) }"""
        model, layers = quantized(graph(text, w=w, b=b, to=np.array([1, 5, 4])), style, {"y": (0.0, 3.0)})
        assert layers[0].output == "y"
        wanted = np.maximum(
            conv(rounded(IMAGE, style, convolved=True), rounded_weight(w, style, 0)) + b[:, None, None], 0
        )
        if style.fused_convolutions:
            wanted = rounded(wanted, style, 0.0, 3.0)
            assert kinds(model)["QuantizeLinear"] == 2
        step = 3.0 / 255 if style.fused_convolutions else 0.0  # a tie may be rounded the other way
        np.testing.assert_allclose(run(model, x=IMAGE)["z"].ravel(), wanted.ravel(), rtol=1e-3, atol=1e-3 + step)

    def test_a_residual_sum(self, style: Style) -> None:
        x, y = X, weight(4, 6, seed=5)
        model, layers = quantized(
            graph("(float[4,6] x, float[4,6] y) => (float[4,6] z) { z = Add(x, y) }"), style, {}, elementwise=True
        )
        assert [layer.kind for layer in layers] == ["Add"]
        close(run(model, x=x, y=y)["z"], rounded(x, style) + rounded(y, style))

    def test_attention(self, style: Style) -> None:
        q, k, v = (weight(1, 4, 6, seed=seed) for seed in (1, 2, 3))
        text = """(float[1,4,6] q, float[1,4,6] k, float[1,4,6] v) => (float[1,4,6] y)
            { kt = Transpose<perm=[0,2,1]>(k)  s = MatMul(q, kt)  p = Softmax(s)  y = MatMul(p, v) }"""
        model, layers = quantized(graph(text), style, {"p": (0.0, 1.0)}, attention=True)
        assert [layer.weight for layer in layers] == ["", ""]
        scores = rounded(q, style) @ rounded(k, style).swapaxes(1, 2)
        shares = np.exp(scores - scores.max(-1, keepdims=True))
        shares /= shares.sum(-1, keepdims=True)
        close(run(model, q=q, k=k, v=v)["y"], rounded(shares, style, 0.0, 1.0) @ rounded(v, style))
        assert find_layers(graph(text), OPS) == []


@pytest.mark.parametrize("reduced", [True, False])
def test_keys_and_values_keep_to_7_bits_outside_the_calibrated_range_where_pairs_saturate(reduced: bool) -> None:
    style = Style(reduce_range=reduced, signed_second=True)
    text = "(float[1,4,6] q, float[1,6,4] k) => (float[1,4,4] s, float[1,4,5] y) { s = MatMul(q, k)  y = MatMul(q, w) }"
    model, _ = quantized(graph(text, w=weight(6, 5)), style, {}, attention=True)
    assert use_integer_matmul(model) == 2
    assert ("Clip" in kinds(model)) is reduced
    if reduced:
        assert weights_fit(model.SerializeToString()), "so that no engine is asked for its exact mode"
        feeds = {"q": np.full((1, 4, 6), 30, np.float32), "k": np.full((1, 6, 4), 30, np.float32)}
        session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        np.testing.assert_allclose(session.run(["s"], feeds)[0], 6 * 3.0 * 3.0, rtol=0.02)


def test_an_input_that_is_shared_is_quantized_once_and_so_is_a_weight() -> None:
    text = "(float[4,6] x) => (float[4,6] y) { a = MatMul(x, w)  b = MatMul(x, v)  c = Add(a, b)  y = MatMul(c, w) }"
    model, layers = quantized(graph(text, w=weight(6, 6), v=weight(6, 6, seed=1)), Style(), {"c": (-9.0, 9.0)})
    assert len(layers) == 3
    assert kinds(model)["QuantizeLinear"] == 2  # x and c
    assert kinds(model)["DequantizeLinear"] == 4  # x, c, w, v
    names = [tensor.name for tensor in model.graph.initializer]
    assert "w" not in names
    assert len(names) == len(set(names))


def test_a_weight_that_something_else_reads_too_stays() -> None:
    text = "(float[4,6] x) => (float[4,6] y, float[6,6] z) { y = MatMul(x, w)  z = Neg(w) }"
    model, _ = quantized(graph(text, w=weight(6, 6)), Style(), {})
    np.testing.assert_array_equal(run(model, x=X)["z"], -weight(6, 6))


def test_a_weight_that_a_branch_reads_stays() -> None:
    """What If reads from outside is in no list of inputs."""
    text = """(float[4,6] x, bool c) => (float[4,6] y) { m = MatMul(x, w)
        y = If(c) <then_branch = t () => (float[4,6] a) { a = Mul(m, k) },
                   else_branch = e () => (float[4,6] b) { b = MatMul(m, w) }> }"""
    model, _ = quantized(graph(text, w=weight(6, 6), k=weight(6)), Style(), {})
    assert {"m", "w", "k", "c"} <= read_names(graph(text).graph.node)
    for flag in (True, False):
        assert run(model, x=X, c=np.array(flag))["y"].shape == (4, 6)


@pytest.mark.parametrize("style", STYLES.values(), ids=STYLES)
def test_what_a_convolution_gives_as_an_output_stays_float(style: Style) -> None:
    w = weight(5, 3, 4, 4, scale=0.1)
    text = "(float[1,3,8,8] x) => (float[1,5,2,2] y) { y = Conv<strides=[4,4]>(x, w) }"
    model, _ = quantized(graph(text, w=w), style, {"y": (-0.001, 0.001)})
    close(run(model, x=IMAGE)["y"], conv(rounded(IMAGE, style, convolved=True), rounded_weight(w, style, 0)))


def test_the_bias_of_a_dead_channel_survives_int32() -> None:
    """Next to no weights and a bias of 1: in units of weight times activation the bias is beyond int32."""
    w, b = weight(5, 3, 4, 4, scale=0.1), np.ones(5, np.float32)
    w[2] *= 1e-12
    w[3] = 0
    text = "(float[1,3,8,8] x) => (float[1,5,2,2] y) { y = Conv<strides=[4,4]>(x, w, b) }"
    for style in (Style(fused_convolutions=True), Style(fused_convolutions=True, per_channel=False)):
        model, _ = quantized(graph(text, w=w, b=b), style, {})
        got = run(model, x=IMAGE)["y"]
        np.testing.assert_allclose(got[:, 2:4], 1.0, rtol=1e-4)
        np.testing.assert_allclose(got, conv(IMAGE, w) + 1, atol=0.15)


@pytest.mark.parametrize("shared", ["w", "b"])
def test_convolutions_may_share_weight_and_bias(shared: str) -> None:
    text = """(float[1,3,8,8] x) => (float[1,5,2,2] y)
        { p = Conv<strides=[4,4]>(x, w, b)  n = Neg(x)  q = Conv<strides=[4,4]>(n, W, B)  y = Sub(p, q) }"""
    text = text.replace("W", "w").replace("B", "c") if shared == "w" else text.replace("W", "v").replace("B", "b")
    w, v, b, c = weight(5, 3, 4, 4), weight(5, 3, 4, 4, seed=4), weight(5, seed=1), weight(5, seed=2, scale=1e9)
    known = {"w": w, "b": b, **({"c": c} if shared == "w" else {"v": v})}
    ranges = {"p": (-40.0, 40.0), "q": (-1e10, 1e10) if shared == "w" else (-40.0, 40.0)}
    model, _ = quantized(graph(text, **known), Style(fused_convolutions=True), ranges)
    other, offset = (w, c) if shared == "w" else (v, b)
    wanted = conv(IMAGE, w) + b[:, None, None] - conv(-IMAGE, other) - offset[:, None, None]
    got = run(model, x=IMAGE)["y"]
    assert np.linalg.norm(got - wanted) / np.linalg.norm(wanted) < 0.05


@pytest.mark.parametrize("span", [1e-44, 1e-30, 0.0, 1e30])
def test_ranges_of_any_size_give_finite_graphs(span: float) -> None:
    w, b = weight(5, 3, 4, 4), weight(5, seed=1)
    text = "(float[1,3,8,8] x) => (float[1,5,2,2] y) { c = Conv<strides=[4,4]>(x, w, b)  y = Relu(c) }"
    for style in STYLES.values():
        model, _ = quantized(graph(text, w=w * np.float32(1e-20), b=b), style, {"x": (-span, span)})
        assert np.isfinite(run(model, x=IMAGE * np.float32(span))["y"]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_weight_that_is_not_finite_is_named(bad: float) -> None:
    w = weight(6, 5)
    w[2, 3] = bad
    text = "(float[4,6] x) => (float[4,5] y) { y = MatMul(x, w) }"
    with pytest.raises(GraphError, match="The weight 'w' holds NaN or infinity"):
        quantized(graph(text, w=w), Style(), {})
    with pytest.raises(GraphError, match=r"The weight 'w' of the layer 'MatMul_0' .* \(1 of 30 values\)"):
        check_weights(graph(text, w=w), find_layers(graph(text, w=w), OPS))
    with pytest.raises(GraphError, match="'w'"):
        quantize_weight(w, 1, "w")


@pytest.mark.parametrize("axis", [None, 0, 1])
@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e30, 1e-44, 0.0])
def test_weights_of_any_size(axis: int | None, scale: float) -> None:
    values = (weight(7, 5).astype(np.float64) * scale).astype(np.float32)
    codes, scales = quantize_weight(values, axis, "w")
    assert codes.dtype == np.int8
    assert scales.shape == (() if axis is None else (values.shape[axis],))
    assert np.abs(codes.astype(int)).max() <= 127
    shape = [1, 1]
    if axis is not None:
        shape[axis] = -1
    meant = codes * scales.reshape(shape)
    assert np.all(np.abs(meant - values) <= scales.reshape(shape) * 0.5001)


RANDOM: list[Callable[[np.random.Generator], str]] = [
    lambda random: f"t{{n}} = MatMul({{v}}, w{random.integers(2)})",
    lambda random: f"t{{n}} = Gemm<transB={random.integers(2)}>({{v}}, w{random.integers(2)}, b)",
    lambda random: "t{n} = Relu({v})",
    lambda random: "t{n} = Transpose<perm=[1,0]>({v})",
    lambda random: "t{n} = Add({v}, {u})",
    lambda random: "t{n} = MatMul({v}, {u})",
    lambda random: "t{n} = Reshape({v}, to)",
]


@pytest.mark.parametrize("seed", range(small_or_full(8, 25)))
def test_random_graphs_stay_near_float_in_every_style(seed: int) -> None:
    random = np.random.default_rng(seed)
    values, lines = ["x"], []
    for number in range(int(random.integers(3, 12))):
        line = random.choice(np.array(RANDOM, object))(random)
        v, u = random.choice(values, 2)
        lines.append(line.format(n=number, v=v, u=u))
        values.append(f"t{number}")
    outputs = sorted({values[-1], str(random.choice(values[1:]))})
    given = ", ".join(f"float[6,6] {name}" for name in outputs)
    text = f"(float[6,6] x) => ({given}) {{ {'  '.join(lines)} }}"
    known = {"w0": weight(6, 6, scale=0.4), "w1": weight(6, 6, seed=1, scale=0.4), "b": weight(6, seed=2)}
    known["to"] = np.array([6, 6])
    x = weight(6, 6, seed=seed)
    whole = graph(text, **known)
    del whole.graph.output[:]
    whole.graph.output.extend(onnx.ValueInfoProto(name=name) for name in values[1:])
    seen = run(whole, x=x) | {"x": x}
    if max(float(np.abs(each).max()) for each in seen.values()) > 1e4:
        pytest.skip("the random graph explodes")
    ranges = {name: (min(float(each.min()), 0.0), max(float(each.max()), 0.0)) for name, each in seen.items()}
    for style in STYLES.values():
        model, _ = quantized(graph(text, **known), style, ranges, attention=True, elementwise=True)
        got = run(model, x=x)
        for name in outputs:
            assert np.linalg.norm(got[name] - seen[name]) <= 0.3 * np.linalg.norm(seen[name]) + 1e-3


NEAR_CONCAT = {
    "before": """(float[1,8,8,8] a, float[1,8,8,8] b) => (float[1,16,8,8] y)
        { x = Concat<axis=1>(a, b)  y = Conv(x, w, k) }""",
    "after, as patches and a class token": """(float[1,8,8,16] a, float[1,8,8,16] b) => (float[1,65,16] y)
        { s = Add(a, b)  x = Transpose<perm=[0,3,1,2]>(s)  c = Conv(x, w, k)  r = Reshape(c, to)
          t = Transpose<perm=[0,2,1]>(r)  y = Concat<axis=1>(token, t) }""",
}


@pytest.mark.parametrize("kind", ["symmetric", "int8"])
@pytest.mark.parametrize("text", NEAR_CONCAT.values(), ids=NEAR_CONCAT)
def test_openvino_computes_convolutions_near_a_concat_as_they_are_written(text, kind, tmp_path):
    known = {"w": weight(16, 16, 1, 1, scale=0.2), "k": weight(16), "to": np.array([1, 16, 64])}
    known["token"] = weight(1, 1, 16, seed=3)
    used = {name: value for name, value in known.items() if f"{name})" in text or f"{name}," in text}
    style = Style(kind, hoist=True, unsigned_convolutions=True, reduce_range=not exact("openvino"))
    model, _ = quantized(graph(text, **used), style, {})
    onnx.save(model, tmp_path / "graph.onnx")
    feeds = {value.name: weight(*(each.dim_value for each in value.type.tensor_type.shape.dim), seed=seed, scale=0.7)
             for seed, value in enumerate(model.graph.input)}  # fmt: skip
    wanted = run(model, **feeds)["y"]
    got = OpenvinoSession(tmp_path / "graph.onnx", 1).run(feeds)["y"]
    assert np.linalg.norm(got - wanted) < 0.02 * np.linalg.norm(wanted)
