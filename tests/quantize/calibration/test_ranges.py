"""Ranges of activations: streaming equals whole, and each method against a reference that does it the slow way."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from _full import small_or_full

from vlatool.quantize.calibration.ranges import (
    BINS,
    LEVELS,
    MAX_CLIPPED_ENERGY,
    MAX_SAMPLED_ELEMENTS,
    Method,
    Statistics,
    choose_range,
)

METHODS: tuple[Method, ...] = ("minmax", "percentile", "entropy", "mse")


def draws(seed: int, count: int = 20_000) -> dict[str, np.ndarray]:
    """Values of every shape that activations come in."""
    random = np.random.default_rng(seed)
    normal = random.standard_normal(count).astype(np.float32)
    found = {
        "gaussian": normal,
        "shifted": normal * 2 + 3,
        "uniform": random.uniform(-4, 4, count).astype(np.float32),
        "heavy-tailed": random.standard_t(2, count).astype(np.float32),
        "one-sided": np.maximum(normal, 0),
        "positive": np.abs(normal) + 1,
        "negative": -np.abs(normal) - 1,
        "all-zero": np.zeros(count, np.float32),
        "constant": np.full(count, 5, np.float32),
        "constant-negative": np.full(count, -0.3, np.float32),
        "tiny": normal * np.float32(1e-30),
        "huge": normal * np.float32(1e30),
        "subnormal": np.full(count, 1e-44, np.float32),
        "single": np.array([-2.5], np.float32),
    }
    return {name: values.astype(np.float32) for name, values in found.items()}


KINDS = sorted(draws(0, 4))


def of(values: np.ndarray) -> Statistics:
    found = Statistics()
    found.add(values)
    return found


def error(values: np.ndarray, low: float, high: float) -> float:
    """Squared error of quantizing to 256 levels between low and high."""
    wide = values.astype(np.float64)
    if high <= low:
        return float((wide**2).sum())
    step = (high - low) / (LEVELS - 1)
    rounded = np.round((np.clip(wide, low, high) - low) / step) * step + low
    return float(((rounded - wide) ** 2).sum())


def in_parts(values: np.ndarray, seed: int) -> Iterator[np.ndarray]:
    random = np.random.default_rng(seed)
    order = random.permutation(values)
    yield from np.split(order, np.sort(random.integers(0, len(values), 7)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_a_folding_histogram_equals_that_of_the_whole_data(kind: str, seed: int) -> None:
    values = draws(seed)[kind]
    streamed, whole = Statistics(), of(values)
    for part in in_parts(values, seed):
        streamed.add(part)
    assert (streamed.low, streamed.high, streamed.radius) == (whole.low, whole.high, whole.radius)
    np.testing.assert_array_equal(streamed.counts, whole.counts)
    assert int(whole.counts.sum()) == len(values)


def test_growing_values_fold_the_histogram_many_times() -> None:
    random = np.random.default_rng(3)
    parts = [random.uniform(-1, 1, 500) * 10.0**power for power in range(-6, 7)]
    streamed = Statistics()
    for part in parts:
        streamed.add(part)
    whole = of(np.concatenate(parts))
    assert streamed.radius == whole.radius >= 2.0 ** math.frexp(1e5)[1]
    np.testing.assert_array_equal(streamed.counts, whole.counts)


@pytest.mark.parametrize("first", [0.0, 1e-30])
def test_zeros_before_small_values_do_not_blur_them(first: float) -> None:
    small = np.random.default_rng(0).standard_normal(1000) * 1e-30
    late, early = Statistics(), of(small)
    late.add(np.full(10, first))
    late.add(small)
    assert late.radius == early.radius
    assert int((late.counts > 0).sum()) > 500


def test_no_elements_change_nothing() -> None:
    found = of(np.zeros((0, 4), np.float32))
    assert (found.samples, found.low, found.high) == (0, 0.0, 0.0)
    assert choose_range(found, "mse", 99, symmetric=False) == (0.0, 0.0)


@pytest.mark.parametrize("shape", [(196, 768), (1, 512, 384), (300_000,), (64, 56, 56)])
def test_large_tensors_are_seen_in_every_channel(shape: tuple[int, ...]) -> None:
    """A stride that divides the channels would see the same few of them only; the extremes see everything."""
    values = np.broadcast_to(np.arange(shape[-1]) % 64 + 1.0, shape).copy()
    values.flat[1] = 900.0
    found = of(values)
    assert found.high == 900.0
    assert MAX_SAMPLED_ELEMENTS // 3 < found.counts.sum() <= MAX_SAMPLED_ELEMENTS
    seen = np.unique(np.floor(found.centres()[found.counts > 0]))
    assert len(seen) >= min(60, shape[-1])


def test_peaks_are_kept_by_channel() -> None:
    found = Statistics(channels=True)
    found.add(np.array([[[1.0, -7.0, 2.0]], [[-3.0, 1.0, 2.0]]]))
    found.add(np.array([[0.0, 0.0, -9.0]]))
    assert found.peaks is not None
    assert found.peaks.tolist() == [3.0, 7.0, 9.0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_minmax_is_exact_and_holds_zero(kind: str, seed: int) -> None:
    values = draws(seed)[kind]
    low, high = choose_range(of(values), "minmax", 99, symmetric=False)
    assert (low, high) == (min(float(values.min()), 0.0), max(float(values.max()), 0.0))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", METHODS)
def test_every_range_holds_zero_and_lies_within_the_extremes(kind: str, method: Method) -> None:
    statistics = of(draws(7)[kind])
    low, high = choose_range(statistics, method, 99.9, symmetric=False)
    assert min(statistics.low, 0.0) <= low <= 0.0 <= high <= max(statistics.high, 0.0)
    assert math.isfinite(low)
    assert math.isfinite(high)
    radius = max(-statistics.low, statistics.high)
    low, high = choose_range(statistics, method, 99.9, symmetric=True)
    assert low == -high
    assert 0 <= high <= radius
    assert (high > 0) == (radius > 0)


@pytest.mark.parametrize("method", METHODS)
def test_what_is_never_negative_may_stay_unsigned(method: Method) -> None:
    for kind in ("one-sided", "positive"):
        statistics = of(draws(1)[kind])
        low, high = choose_range(statistics, method, 99.9, symmetric=True, unsigned=True)
        assert low == 0.0 < high
    low, high = choose_range(of(draws(1)["gaussian"]), method, 99.9, symmetric=True, unsigned=True)
    assert low == -high < 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("percentile", [60.0, 99.0, 99.99, 100.0])
def test_the_percentile_keeps_the_central_share(kind: str, percentile: float) -> None:
    values = draws(5)[kind]
    statistics = of(values)
    low, high = choose_range(statistics, "percentile", percentile, symmetric=False)
    tail = (100 - percentile) / 2
    wanted = np.percentile(values.astype(np.float64), [tail, 100 - tail], method="inverted_cdf")
    width = 2 * statistics.radius / BINS
    assert abs(low - min(wanted[0], 0.0)) <= width
    assert abs(high - max(wanted[1], 0.0)) <= width
    if percentile == 100:
        assert (low, high) == choose_range(statistics, "minmax", 99, symmetric=False)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_mse_is_as_good_as_a_search_over_all_ranges(kind: str, symmetric: bool, seed: int) -> None:
    values = draws(seed, 4000)[kind]
    low, high = choose_range(of(values), "mse", 99, symmetric=symmetric)
    got = error(values, low, high)
    bottom, top = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    shares = np.geomspace(0.01, 1, 60)
    if symmetric:
        radius = max(-bottom, top)
        best = min(error(values, -radius * share, radius * share) for share in shares)
    else:
        best = min(error(values, bottom * a, top * b) for a in shares[::3] for b in shares[::3])
    assert got <= 1.1 * best + 1e-300
    assert got <= 1.03 * error(values, bottom if not symmetric else -radius, top if not symmetric else radius)


def test_mse_cuts_rare_outliers_whether_symmetric_or_not() -> None:
    values = np.random.default_rng(0).standard_normal(60_000).astype(np.float32)
    statistics = Statistics()
    for _ in range(20):
        statistics.add(values)
    statistics.add(np.array([500.0], np.float32))
    for symmetric in (False, True):
        low, high = choose_range(statistics, "mse", 99, symmetric=symmetric)
        assert 3 < high < (100 if symmetric else 250)  # the range of the latter is not wasted on one side
        assert low < -2


def slow_entropy(values: np.ndarray, statistics: Statistics) -> float:
    """Migacz's calibration, element by element, over the same bins: without zeros, and within what may be clipped."""
    half = BINS // 2
    above = [float(statistics.counts[half + i]) for i in range(half)]
    below = [float(statistics.counts[half - 1 - i]) for i in range(half)]
    for side in (above, below):
        side[0] = min(side[0], side[1])
    counts = [a + b for a, b in zip(above, below, strict=True)]
    energy = [count * (i + 0.5) ** 2 for i, count in enumerate(counts)]
    last = max((i for i, count in enumerate(counts) if count), default=-1) + 1
    first = next(i + 1 for i in range(half) if sum(energy[i + 1 :]) <= MAX_CLIPPED_ENERGY * sum(energy))
    best, threshold = math.inf, last
    for stop in range(max(128, first), last + 1, 8):
        p = counts[:stop]
        p[-1] += sum(counts[stop:])
        q = [0.0] * stop
        for level in range(128):
            members = [i for i in range(stop) if i * 128 // stop == level and counts[i]]
            for i in members:
                q[i] = sum(counts[j] for j in members) / len(members)
        total, made = sum(p), sum(q)
        if not total or not made:
            continue
        loss = sum(a / total * math.log((a / total) / max(b / made, 1e-12)) for a, b in zip(p, q, strict=True) if a)
        if loss < best:
            best, threshold = loss, stop
    return min(threshold * statistics.radius / half, float(np.abs(values).max()))


@pytest.mark.parametrize("kind", ["gaussian", "heavy-tailed", "one-sided", "tiny", "huge", "constant", "all-zero"])
def test_entropy_finds_the_threshold_of_the_plain_algorithm(kind: str) -> None:
    values = draws(2, 3000)[kind]
    values = values[np.abs(values) <= 0.12 * np.abs(values).max()] if kind == "heavy-tailed" else values
    statistics = of(values)
    thinned = statistics
    if kind != "constant":  # the slow way is slow: fold the histogram four times first
        thinned = of(np.append(values, np.float32(0)))
        for _ in range(2):
            thinned._grow(thinned.radius)
    threshold = slow_entropy(values, thinned)
    low, high = choose_range(thinned, "entropy", 99, symmetric=True)
    assert high == pytest.approx(threshold, rel=1e-6)
    assert low == -high


SPARSE = {
    "relu": lambda x: np.maximum(x, 0),
    "relu, 1 in 100": lambda x: np.maximum(x - 2.33, 0),
    "relu squared": lambda x: np.maximum(x, 0) ** 2,
    "leaky": lambda x: np.where(x > 0, x, x * 1e-3),
    "relu6": lambda x: np.clip(4 * x, 0, 6),
    "silu": lambda x: x / (1 + np.exp(-6 * x)),
    "masked": lambda x: np.where(np.arange(len(x)) % 10 > 0, 0, x),
    "softmax": lambda x: np.exp(4 * x) / np.exp(4 * x).reshape(-1, 50).sum(-1).repeat(50),
    "negative": lambda x: np.minimum(x, 0),
}
"""Activations with many zeros, or nearly so, and fewer values that matter."""


@pytest.mark.parametrize("kind", SPARSE)
@pytest.mark.parametrize("symmetric", [True, False])
def test_entropy_is_not_decided_by_zeros_and_keeps_what_matters(kind: str, symmetric: bool) -> None:
    normal = np.random.default_rng(5).standard_normal(50_000)
    values = SPARSE[kind](normal).astype(np.float32)
    low, high = choose_range(of(values), "entropy", 99, symmetric, unsigned=True)
    assert error(values, low, high) < 5 * MAX_CLIPPED_ENERGY * float((values.astype(np.float64) ** 2).sum())


@pytest.mark.parametrize("seed", range(small_or_full(6, 20)))
def test_random_data_in_random_pieces(seed: int) -> None:
    """Whatever the scale, the order and the mixture: ranges stay ordered, and mse is no worse than minmax."""
    random = np.random.default_rng(seed)
    scale = 10.0 ** random.uniform(-12, 12)
    count = int(random.integers(1, 3000))
    values = (random.standard_normal(count) * random.choice([1, 1, 1, 40], count) + random.uniform(-3, 3)) * scale
    values = values.astype(np.float32)
    statistics = Statistics()
    for part in in_parts(values, seed):
        statistics.add(part)
    full = choose_range(statistics, "minmax", 99, symmetric=False)
    for method in METHODS:
        low, high = choose_range(statistics, method, 99.9, symmetric=False)
        assert full[0] <= low <= 0 <= high <= full[1]
    low, high = choose_range(statistics, "mse", 99, symmetric=False)
    assert error(values, low, high) <= 1.02 * error(values, *full)
