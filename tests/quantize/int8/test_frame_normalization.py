"""Normalisations of frames, folded into the convolution that reads them."""

from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.graph.layers import Style, find_layers
from vlatool.graph.qdq import insert_qdq
from vlatool.quantize.int8.frame_normalization import fold_normalization
from vlatool.quantize.int8.quantizer_hoisting import hoist_quantizers

RANDOM = np.random.default_rng(0)
FRAME = RANDOM.integers(0, 256, (1, 8, 8, 3)).astype(np.uint8)
MEAN = np.float32([123.7, 116.3, 103.5])
STD = np.float32([58.4, 57.1, 57.4])
CONSTANTS: dict[str, Any] = {
    "mean": MEAN, "std": STD, "scale": 1 / STD, "shift": -MEAN / STD, "mean_first": MEAN.reshape(1, 3, 1, 1),
    "std_first": STD.reshape(3, 1, 1), "uneven": np.float32([1, 1, 9]), "dead": np.float32([1, 1, 0]),
    "field": RANDOM.normal(size=(8, 8, 3)).astype(np.float32), "full": np.float32(255),
    "shape": np.int64([1, 3, 8, 8]),
    "w": RANDOM.normal(size=(5, 3, 4, 4)).astype(np.float32),
    "each": RANDOM.normal(size=(3, 1, 4, 4)).astype(np.float32),
    "bias": RANDOM.normal(size=5).astype(np.float32),
}  # fmt: skip
CAST = ("Cast", "image", "c", {"to": TensorProto.FLOAT})
TURN = ("Transpose", "b", "t", {"perm": [0, 3, 1, 2]})
NORMALISE = [CAST, ("Sub", "c mean", "a", {}), ("Div", "a std", "b", {}), TURN]
PATCHES = ("Conv", "t w bias", "y", {"strides": [4, 4]})


def model(*nodes: tuple[str, str, str, dict[str, Any]], outputs: tuple[str, ...] = ("y",)) -> onnx.ModelProto:
    made = [helper.make_node(kind, inputs.split(), [to], name=f"make {to}", **how) for kind, inputs, to, how in nodes]
    read = {name for each in made for name in each.input}
    graph = helper.make_graph(
        made, "main", [helper.make_tensor_value_info("image", TensorProto.UINT8, FRAME.shape)],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in CONSTANTS.items() if name in read],
    )  # fmt: skip
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)


def run(made: onnx.ModelProto) -> list[np.ndarray]:
    session = onnxruntime.InferenceSession(made.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"image": FRAME})


def folded(made: onnx.ModelProto, names: tuple[str, ...] = ("make y",)) -> dict[str, tuple[float, float]]:
    before = run(made)
    found = fold_normalization(made, names)
    for got, wanted in zip(run(made), before, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4)
    return found


def kinds(made: onnx.ModelProto) -> list[str]:
    return [node.op_type for node in made.graph.node]


WAYS = {
    "subtract and divide": NORMALISE,
    "scale and shift": [CAST, ("Mul", "scale c", "a", {}), ("Add", "a shift", "b", {}), TURN],
    "channels first": [CAST, ("Transpose", "c", "b", {"perm": [0, 3, 1, 2]}), ("Sub", "b mean_first", "a", {}),
                       ("Div", "a std_first", "t", {})],
    "turned as pixels": [("Transpose", "image", "i", {"perm": [0, 3, 1, 2]}), ("Reshape", "i shape", "j", {}),
                         ("Cast", "j", "c", {"to": TensorProto.FLOAT}), ("Sub", "c mean_first", "a", {}),
                         ("Div", "a std_first", "t", {})],
    "one for all": [CAST, ("Div", "c full", "b", {}), TURN],
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_a_normalisation_becomes_weights_and_one_level(way):
    made = model(*WAYS[way], PATCHES)
    ((value, (low, high)),) = folded(made).items()
    assert value == made.graph.node[-1].input[0]
    assert sorted(set(kinds(made)) - {"Reshape"}) == ["Cast", "Conv", "Sub", "Transpose"]
    level = 0 if way == "one for all" else round(float(MEAN.mean()))
    assert (low, high) == (-level, 255 - level)


@pytest.mark.parametrize("pads", [[1, 1, 1, 1], [3, 0, 0, 2], [0, 2, 0, 0], [0, 1, 2, 3]], ids=str)
@pytest.mark.parametrize("way", WAYS)
def test_padding_becomes_a_border_of_pixels(way, pads):
    """The mean is no whole pixel, so that the border is off by half a pixel at most, as quantized zeros would be."""
    made = model(*WAYS[way], ("Conv", "t w bias", "y", {"strides": [2, 2], "pads": pads}))
    (before,) = run(made)
    ((_, (low, high)),) = fold_normalization(made, ("make y",)).items()
    assert high - low == 255
    (after,) = run(made)
    assert after.shape == before.shape
    half = 0 if way == "one for all" else 0.5 / STD.min()
    assert np.abs(after - before).max() <= half * np.abs(CONSTANTS["w"]).sum(axis=(1, 2, 3)).max() + 1e-3
    inner = (slice(None), slice(None), slice(2, 3), slice(2, 3))
    np.testing.assert_allclose(after[inner], before[inner], rtol=1e-4, atol=1e-4)
    assert not [item for item in made.graph.node[-1].attribute if item.name == "pads"]


def test_a_convolution_without_bias_gets_one():
    made = model(*NORMALISE, ("Conv", "t w", "y", {"strides": [4, 4]}))
    assert folded(made)
    assert len(made.graph.node[-1].input) == 3


REFUSED = {
    "padding that is no pixel": [
        CAST,
        ("Mul", "scale c", "a", {}),
        ("Add", "a std", "b", {}),
        TURN,
        ("Conv", "t w bias", "y", {"pads": [1, 1, 1, 1]}),
    ],
    "padding that is left to the engine": [*NORMALISE, ("Conv", "t w bias", "y", {"auto_pad": "SAME_UPPER"})],
    "groups": [*NORMALISE, ("Conv", "t each", "y", {"group": 3})],
    "scales that are far apart": [CAST, ("Mul", "c uneven", "b", {}), TURN, PATCHES],
    "a channel that is taken out": [CAST, ("Mul", "c dead", "b", {}), TURN, PATCHES],
    "another one at each pixel": [CAST, ("Mul", "c field", "b", {}), TURN, PATCHES],
    "a product with itself": [CAST, ("Mul", "c c", "b", {}), TURN, PATCHES],
    "a constant that is divided": [CAST, ("Add", "c full", "a", {}), ("Div", "full a", "b", {}), TURN, PATCHES],
    "nothing to fold": [("Cast", "image", "b", {"to": TensorProto.FLOAT}), TURN, PATCHES],
    "something between": [*NORMALISE[:2], ("Relu", "a", "b", {}), TURN, PATCHES],
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_folded_stays(why):
    made = model(*REFUSED[why])
    before = made.SerializeToString()
    assert folded(made) == {}
    assert made.SerializeToString() == before


@pytest.mark.parametrize("outputs", [("y", "t"), ("y", "n")])
def test_what_others_read_stays(outputs):
    made = model(*NORMALISE, PATCHES, ("Neg", "a", "n", {}), outputs=outputs)
    assert folded(made) == {}


def test_only_convolutions_that_are_named_are_changed():
    assert folded(model(*NORMALISE, PATCHES), ()) == {}


@pytest.mark.parametrize("pads", [[0, 0, 0, 0], [1, 1, 1, 1]], ids=str)
@pytest.mark.parametrize("way", WAYS)
def test_a_folded_frame_is_quantized_as_the_pixels_that_it_is(way, pads):
    made = model(*WAYS[way], ("Conv", "t w bias", "y", {"strides": [2, 2], "pads": pads}))
    (wanted,) = run(made)
    ranges = fold_normalization(made, ("make y",))
    style = Style(fused_convolutions=True)
    insert_qdq(made, find_layers(made, ("Conv",)), ranges, style)
    hoist_quantizers(made)
    assert "QuantizeLinear" not in kinds(made), "pixels need no quantizer"
    assert "Cast" not in kinds(made)
    (got,) = run(made)
    assert np.linalg.norm(got - wanted) < 0.02 * np.linalg.norm(wanted)
