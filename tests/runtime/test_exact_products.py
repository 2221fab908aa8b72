"""Weights that fit in pairs are multiplied exactly by every kernel, whatever the processor.

With the largest activations, and sums of neighbours that are as large as allowed.
"""

from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import numpy_helper

from vlatool.runtime.engine import engine_class
from vlatool.weights.pairs import neighbours, pairs_fit

PRODUCT = """<ir_version: 10, opset_import: ["" : 20, "com.microsoft" : 1]>
g (uint8[{rows},{inner}] x) => (float[{rows},{columns}] y) {{
  y = com.microsoft.MatMulIntegerToFloat(x, w, one, one, zero, zeros)
}}"""
QDQ_PRODUCT = """<ir_version: 10, opset_import: ["" : 20]>
g (float[{rows},{inner}] x) => (float[{rows},{columns}] y) {{
  q = QuantizeLinear(x, one, zero)  d = DequantizeLinear(q, one, zero)  v = DequantizeLinear(w, one)  y = MatMul(d, v)
}}"""
CONVOLUTION = """<ir_version: 10, opset_import: ["" : 20]>
g (float[1,{inner},9,9] x) => (float[1,{columns},N,M] y) {{
  q = QuantizeLinear(x, one, zero)  d = DequantizeLinear(q, one, zero)  v = DequantizeLinear(w, one)
  {rest}
}}"""
PLAIN, QUANTIZED = (
    "y = Conv(d, v)",
    """c = Conv(d, v)  r = QuantizeLinear(c, step, half)  y = DequantizeLinear(r, step, half)""",
)
MEETS = [0, 127, 127, 0, -127, 0, 0, -127]
"""Weights whose neighbours fit, and of which two would saturate if the first were the second of a pair; they cancel."""


def extreme(kind: str, shape: tuple[int, ...], axis: int, seed: int) -> np.ndarray:
    """Weights with long runs of one sign, in which as many neighbours as possible add up to 127."""
    random = np.random.default_rng(seed)
    codes = random.integers(-127, 128, shape).astype(np.int8)
    codes[random.random(shape) < 0.7] = 63
    for _ in range(16):
        for first, second in neighbours(np.arange(codes.size).reshape(shape), kind, axis):
            one, other = codes.ravel()[first].astype(int), codes.ravel()[second].astype(int)
            excess = np.maximum(np.abs(one + other) - 127, 0) * np.sign(one + other)
            codes.ravel()[second.ravel()] = (other - excess).clip(-127, 127).astype(np.int8).ravel()
    assert pairs_fit(codes, kind, axis)
    return codes


def session(text: str, weights: dict[str, np.ndarray], folder: Path, engine: str):
    model = onnx.parser.parse_model(text)
    scalars = {"one": np.float32(1), "zero": np.uint8(0), "step": np.float32(4096), "half": np.uint8(128)}
    for name, value in {**scalars, **weights}.items():
        if any(name in node.input for node in model.graph.node):
            model.graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    onnx.save(model, folder / "graph.onnx")
    return engine_class(engine)(folder / "graph.onnx", 1)


@pytest.mark.parametrize("rows", [1, 2, 5, 197])
@pytest.mark.parametrize(("inner", "columns"), [(2, 1), (3, 3), (7, 16), (64, 17), (129, 8), (384, 48)])
def test_onnx_runtime_multiplies_them_exactly(rows: int, inner: int, columns: int, tmp_path: Path) -> None:
    codes = extreme("MatMul", (inner, columns), 1, seed=rows + inner)
    weights = {"w": codes, "zeros": np.int8(0)}
    opened = session(PRODUCT.format(rows=rows, inner=inner, columns=columns), weights, tmp_path, "ort_cpu")
    for activations in (np.full((rows, inner), 255, np.uint8),
                        np.random.default_rng(0).integers(200, 256, (rows, inner)).astype(np.uint8)):  # fmt: skip
        wanted = activations.astype(np.int64) @ codes.astype(np.int64)
        assert opened.run({"x": activations})["y"].tolist() == wanted.tolist()


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
@pytest.mark.parametrize(("rows", "inner", "columns"), [(1, 64, 16), (33, 130, 40)])
def test_pairs_of_quantizers_are_multiplied_exactly(engine: str, rows: int, inner: int, columns: int, tmp_path) -> None:
    codes = extreme("MatMul", (inner, columns), 1, seed=inner)
    opened = session(QDQ_PRODUCT.format(rows=rows, inner=inner, columns=columns), {"w": codes}, tmp_path, engine)
    activations = np.full((rows, inner), 255, np.float32)
    assert opened.run({"x": activations})["y"].tolist() == (activations @ codes.astype(np.float32)).tolist()


@pytest.mark.parametrize(("channels", "size"), [(3, 3), (4, 3), (16, 1), (17, 3), (64, 3), (3, 7)])
def test_openvino_convolves_them_exactly(channels: int, size: int, tmp_path: Path) -> None:
    codes = extreme("Conv", (8, channels, size, size), 0, seed=channels)
    opened = session(CONVOLUTION.format(inner=channels, columns=8, rest=PLAIN), {"w": codes}, tmp_path, "openvino")
    found = opened.run({"x": np.full((1, channels, 9, 9), 255, np.float32)})["y"]
    assert (found == (255 * codes.astype(np.int64).sum((1, 2, 3)))[:, None, None]).all()


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
@pytest.mark.parametrize(("channels", "size"), [(8, 1), (8, 3), (16, 3), (64, 3), (2, 2)])
def test_convolutions_add_up_the_channels_of_a_position_first(engine: str, channels: int, size: int, tmp_path) -> None:
    row = np.resize(np.array(MEETS, np.int8), (size, size, channels))
    codes = np.repeat(row.transpose(2, 0, 1)[None], 8, axis=0)
    assert pairs_fit(codes, "Conv", 0)
    opened = session(CONVOLUTION.format(inner=channels, columns=8, rest=QUANTIZED), {"w": codes}, tmp_path, engine)
    found = opened.run({"x": np.full((1, channels, 9, 9), 255, np.float32)})["y"]
    assert not found.any()
