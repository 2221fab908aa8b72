import numpy as np
import pytest

from vlatool.graph.qdq import quantize_weight
from vlatool.weights.pairs import largest_sums, neighbours, pairs_fit

SHAPES = [
    ("MatMul", (7, 5), 1), ("MatMul", (64, 16), 1), ("MatMul", (3, 8, 4), 2), ("MatMul", (1, 6), 1),
    ("Gemm", (5, 7), 0), ("Gemm", (16, 64), 0), ("Conv", (8, 3, 3, 3), 0), ("Conv", (8, 4, 3, 3), 0),
    ("Conv", (4, 1, 3, 3), 0), ("Conv", (6, 5, 4), 0), ("Conv", (4, 2, 3, 3, 3), 0),
]  # fmt: skip


def largest_product(codes, kind, axis):
    """What two neighbours make of two activations of 255, the largest magnitude of all pairs."""
    sums = [first.astype(int) + second for first, second in neighbours(codes, kind, axis)]
    return 255 * max((int(np.abs(each).max(initial=0)) for each in sums), default=0)


@pytest.mark.parametrize(("kind", "shape", "axis"), SHAPES)
@pytest.mark.parametrize("seed", range(3))
def test_no_pair_of_a_fitted_weight_leaves_16_bits(kind, shape, axis, seed):
    random = np.random.default_rng(seed)
    weight = (random.standard_t(2, shape) * 10.0 ** random.integers(-3, 4)).astype(np.float32)
    sums = largest_sums(weight, kind, axis)
    assert sums.shape == (shape[axis],)
    for scaled_axis in (axis, None):
        codes, _ = quantize_weight(weight, scaled_axis, "w", sums=sums)
        assert pairs_fit(codes, kind, axis)
        assert largest_product(codes, kind, axis) <= 2**15 - 1


@pytest.mark.parametrize(("first", "second", "right"), [
    (127, 0, True), (64, 63, True), (64, 64, False), (127, 127, False), (-64, -64, True), (-65, -64, False),
    (127, -128, True), (-128, 0, True), (1, 126, True), (2, 126, False),
])  # fmt: skip
def test_two_neighbours_fit_as_long_as_their_sum_is_an_int8(first, second, right):
    codes = np.zeros((4, 3), np.int8)
    codes[2:, 1] = first, second
    assert pairs_fit(codes, "MatMul", 1) is right
    apart = np.zeros((4, 3), np.int8)
    apart[1:3, 1] = first, second
    assert pairs_fit(apart, "MatMul", 1)


def test_channels_are_neighbours_of_a_convolution_and_kernel_positions_are_not():
    codes = np.zeros((1, 2, 1, 3), np.int8)
    codes[0, 0] = 127
    assert pairs_fit(codes, "Conv", 0)
    codes[0, 1, 0, 2] = 1
    assert not pairs_fit(codes, "Conv", 0)


def test_an_odd_number_of_channels_is_looked_at_as_it_is_and_padded():
    meets_the_next_position = np.zeros((1, 3, 1, 2), np.int8)
    meets_the_next_position[0, 2, 0, 0] = meets_the_next_position[0, 0, 0, 1] = 127
    assert not pairs_fit(meets_the_next_position, "Conv", 0)
    within_the_second_position = np.zeros((1, 3, 1, 2), np.int8)
    within_the_second_position[0, 0, 0, 1] = within_the_second_position[0, 1, 0, 1] = 127
    assert not pairs_fit(within_the_second_position, "Conv", 0)


def test_steps_are_a_third_larger_than_those_of_8_bits_and_not_twice_as_large():
    weight = np.random.default_rng(0).standard_normal((768, 256)).astype(np.float32)
    _, whole = quantize_weight(weight, 1, "w")
    _, fitted = quantize_weight(weight, 1, "w", sums=largest_sums(weight, "MatMul", 1))
    assert 1.2 < float(np.median(fitted / whole)) < 1.5


def test_a_weight_of_zeros_and_a_dead_output_stay_zero():
    weight = np.zeros((4, 2), np.float32)
    weight[0, 0] = 3
    codes, scales = quantize_weight(weight, 1, "w", sums=largest_sums(weight, "MatMul", 1))
    assert codes.tolist() == [[126, 0], [0, 0], [0, 0], [0, 0]]
    assert np.isfinite(scales).all()
