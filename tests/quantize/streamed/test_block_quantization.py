"""The arithmetic of block quantization, against plain numpy."""

import numpy as np
import pytest

from vlatool.quantize.streamed._activation_aware import awq, gptq, round_to_nearest
from vlatool.quantize.streamed._block_quantization import (
    METHODS,
    BlockFormat,
    Scratch,
    dequantize,
    pack_zero_points,
    planes_from_bytes,
    planes_from_rows,
    quantize_planes,
    unpack_zero_points,
)

FORMS = [BlockFormat(bits, block, symmetric) for bits in (4, 8) for block in (32, 128) for symmetric in (False, True)]


def weights(count: int = 64 * 1024, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_t(6, count).astype(np.float32) * np.float32(0.02)


def as_stored(values: np.ndarray, dtype: str) -> tuple[np.ndarray, np.ndarray]:
    """Bytes of a dtype, and the float32 numbers that they mean."""
    if dtype == "F32":
        return values.view(np.uint8), values
    if dtype == "F16":
        return values.astype(np.float16).view(np.uint8), values.astype(np.float16).astype(np.float32)
    words = (values.view(np.uint32) >> 16).astype(np.uint16)
    return words.view(np.uint8), (words.astype(np.uint32) << 16).view(np.float32)


def natural(planes: np.ndarray) -> np.ndarray:
    half = len(planes) // 2
    rows = np.empty((planes.shape[1], len(planes)), np.float32)
    rows[:, 0::2], rows[:, 1::2] = planes[:half].T, planes[half:].T
    return rows


@pytest.mark.parametrize("dtype", ["BF16", "F16", "F32"])
def test_planes_hold_the_stored_numbers(dtype):
    raw, wanted = as_stored(weights(4096), dtype)
    planes = planes_from_bytes(raw, dtype, 32, Scratch())
    np.testing.assert_array_equal(natural(planes), wanted.reshape(-1, 32))
    np.testing.assert_array_equal(planes_from_rows(wanted.reshape(-1, 32).T.copy(), Scratch()), planes)


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("method", sorted(METHODS))
def test_the_error_is_that_of_the_stored_codes_and_within_the_bound(form, method):
    values = weights()
    planes = planes_from_bytes(values.view(np.uint8), "F32", form.block, Scratch())
    made = quantize_planes(planes, form, METHODS[method], Scratch())
    assert made.codes.shape == (len(values) // form.block, form.code_bytes)
    meant = dequantize(made.codes, made.scale, made.zero, form)
    error = np.linalg.norm(meant.reshape(-1) - values)
    assert error**2 == pytest.approx(made.squared_error, rel=1e-3)
    assert error / np.linalg.norm(values) < (0.15 if form.bits == 4 else 0.01) < form.largest_error
    if form.symmetric:
        assert set(made.zero.tolist()) == {form.midpoint}


def test_rounding_to_nearest_is_onnx_runtimes():
    values = weights(32 * 500).reshape(-1, 32)
    made = round_to_nearest(values, BlockFormat(), METHODS["rtn"])
    low, high = np.minimum(values.min(1), 0), np.maximum(values.max(1), 0)
    scale = (high - low) / 15
    zero = np.clip(np.rint(-low / scale), 0, 15)
    np.testing.assert_allclose(made.scale[:, 0], scale, rtol=1e-6)
    assert np.mean(made.zero[:, 0] == zero) > 0.999
    codes = np.clip(np.rint(values / scale[:, None]) + zero[:, None], 0, 15)
    assert np.mean(np.abs((codes - zero[:, None]) * scale[:, None] - made.restored) < 1e-6) > 0.999


@pytest.mark.parametrize("form", [form for form in FORMS if form.bits == 4], ids=str)
def test_the_search_loses_less(form):
    values = weights().reshape(-1, form.block)
    plain, best = (round_to_nearest(values, form, METHODS[name]) for name in ("rtn", "searched"))
    assert np.linalg.norm(best.restored - values) < 0.985 * np.linalg.norm(plain.restored - values)


def test_hqq_spares_the_many_at_the_cost_of_outliers():
    values = weights().reshape(-1, 32)
    values[:, 7] *= 10
    plain, made = (
        np.abs(round_to_nearest(values, BlockFormat(), METHODS[name]).restored - values) for name in ("rtn", "hqq")
    )
    assert np.mean(made**0.7) < np.mean(plain**0.7)


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("block", [0.0, 1e-38, 1.0, -3.0])
def test_constant_and_tiny_blocks(form, block):
    values = np.full((4, form.block), block, np.float32)
    for name, choose in METHODS.items():
        made = round_to_nearest(values, form, choose)
        assert np.isfinite(made.scale).all(), name
        np.testing.assert_allclose(made.restored, values, rtol=0.13, atol=1e-30)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_weight_that_is_not_finite_shows_in_the_norm(wrong):
    values = weights(1024)
    values[17] = wrong
    made = quantize_planes(
        planes_from_bytes(values.view(np.uint8), "F32", 32, Scratch()), BlockFormat(), METHODS["rtn"], Scratch()
    )
    assert not np.isfinite(made.squared_norm)


def test_large_finite_weights_are_not_taken_for_infinity():
    values = weights(1024) * np.float32(1e22)
    made = quantize_planes(
        planes_from_bytes(values.view(np.uint8), "F32", 32, Scratch()), BlockFormat(), METHODS["rtn"], Scratch()
    )
    assert np.isfinite(made.squared_norm)


@pytest.mark.parametrize("count", [1, 2, 5, 8])
@pytest.mark.parametrize("bits", [4, 8])
def test_zero_points_are_packed_and_unpacked(count, bits):
    form = BlockFormat(bits)
    zero = np.random.default_rng(0).integers(0, form.levels + 1, (3, count), np.uint8)
    packed = pack_zero_points(zero, form)
    assert packed.shape == (3, -(-count * bits // 8))
    np.testing.assert_array_equal(unpack_zero_points(packed, count, form), zero)


def test_rows_that_are_no_whole_blocks_are_padded():
    values = weights(10 * 50).reshape(10, 50)
    made = round_to_nearest(values, BlockFormat(), METHODS["searched"])
    assert made.codes.shape == (10, 2, 16)
    assert made.restored.shape == values.shape
    assert np.linalg.norm(made.restored - values) < 0.12 * np.linalg.norm(values)


def activations(rows: int, inputs: int) -> np.ndarray:
    """Correlated, with a few inputs that are far more active than others, as in language models."""
    random = np.random.default_rng(1)
    mixed = random.standard_normal((rows, inputs // 4)) @ random.standard_normal((inputs // 4, inputs))
    made = mixed / np.sqrt(inputs / 4) + 0.3 * random.standard_normal((rows, inputs))
    made[:, ::17] *= 12
    return made.astype(np.float32)


@pytest.mark.parametrize("inputs", [128, 150])
@pytest.mark.parametrize("form", [BlockFormat(), BlockFormat(4, 64, True)], ids=str)
def test_gptq_and_awq_lose_less_of_the_product(form, inputs):
    weight = weights(96 * inputs).reshape(96, inputs)
    seen, unseen = np.split(activations(2048, inputs), 2)
    plain = round_to_nearest(weight, form, METHODS["rtn"])

    def lost(made) -> float:
        return float(np.linalg.norm(unseen @ (made.restored - weight).T))

    by_error, by_activation = (method(weight, seen, form, METHODS["rtn"]) for method in (gptq, awq))
    assert lost(by_error) < 0.75 * lost(plain)
    assert lost(by_activation) < 0.9 * lost(plain)
    assert by_activation.input_scale is not None
    assert by_activation.input_scale.shape == (inputs,)


def test_gptq_keeps_the_weights_it_was_given_and_those_of_dead_inputs():
    weight, seen = weights(32 * 64).reshape(32, 64), activations(256, 64)
    seen[:, 5] = 0
    before = weight.copy()
    made = gptq(weight, seen, BlockFormat(), METHODS["searched"])
    np.testing.assert_array_equal(weight, before)
    assert np.linalg.norm(made.restored[:, 5] - weight[:, 5]) < 0.2 * np.linalg.norm(weight[:, 5])
