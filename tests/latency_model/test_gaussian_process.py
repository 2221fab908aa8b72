from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from vlatool.latency_model import gaussian_process
from vlatool.latency_model.gaussian_process import KEYS, Process, Rows, Scales, kernel

SCALES = Scales()


def rows(count: int, seed: int, **changes: int) -> Rows:
    """Random rows; a category is the same number in all of them when it is named."""
    random = np.random.default_rng(seed)
    keys = {name: random.integers(0, 3, count) for name in KEYS}
    keys |= {name: np.full(count, number) for name, number in changes.items()}
    traits = random.integers(0, 2, (count, 5)).astype(float)
    return Rows(keys, random.normal(size=(count, 4)), traits, random.normal(size=(count, 4)), random.normal(size=count))


def measured(told: Rows, seed: int = 9) -> np.ndarray:
    return told.prior + np.random.default_rng(seed).normal(0, 0.5, len(told))


def test_the_posterior_is_the_textbook_formula() -> None:
    told, asked = rows(40, 1), rows(7, 2)
    logs = measured(told)
    noisy = kernel(told, told, SCALES) + SCALES.noise**2 * np.eye(40)
    across = kernel(told, asked, SCALES)
    mean = asked.prior + across.T @ np.linalg.solve(noisy, logs - told.prior)
    covariance = kernel(asked, asked, SCALES) - across.T @ np.linalg.solve(noisy, across)
    process = Process(told, logs, SCALES)
    np.testing.assert_allclose(process.joint(asked)[0], mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(process.joint(asked)[1], covariance, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(process.predict(asked)[1] ** 2, np.diag(covariance) + SCALES.noise**2, rtol=1e-7)


def test_the_kernel_is_a_covariance() -> None:
    found = kernel(rows(30, 3), rows(30, 3), SCALES)
    np.testing.assert_allclose(found, found.T, atol=1e-12)
    assert np.linalg.eigvalsh(found).min() > -1e-9
    parts = [value for name, value in asdict(SCALES).items() if name != "noise" and not name.startswith("length")]
    np.testing.assert_allclose(np.diag(found), np.square(parts).sum())


@pytest.mark.parametrize("name", ["runtime", "core", "device", "line", "model", "known"])
def test_a_shared_category_adds_its_variance(name: str) -> None:
    one = replace(rows(1, 4), keys={key: np.array([1]) for key in KEYS})
    other = replace(one, keys=dict(one.keys) | {name: np.array([2])})
    gap = kernel(one, one, SCALES) - kernel(one, other, SCALES)
    assert gap[0, 0] == pytest.approx(getattr(SCALES, name) ** 2)


def test_the_kernel_is_the_same_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = rows(7, 20), rows(5, 21)
    whole = kernel(first, second, SCALES)
    monkeypatch.setattr(gaussian_process, "BLOCK", 3)
    np.testing.assert_array_equal(kernel(first, second, SCALES), whole)
    one = kernel(first.take(slice(2, 3)), second.take(slice(4, 5)), SCALES)
    np.testing.assert_allclose(one, whole[2:3, 4:5], rtol=1e-12)


def test_devices_that_are_alike_speak_for_each_other() -> None:
    one = replace(rows(1, 4), keys={key: np.array([1]) for key in KEYS})
    near, far = (replace(one, device=one.device + step) for step in (0.1, 9.0))
    assert kernel(one, near, SCALES)[0, 0] > kernel(one, far, SCALES)[0, 0]


def test_a_measurement_moves_its_device_and_narrows_it() -> None:
    told, asked = rows(30, 5, device=1), rows(4, 6, device=7, pair=7, setting=7)
    logs = measured(told)
    before, width = Process(told, logs, SCALES).predict(asked)
    first = asked.take(slice(0, 1))
    slow = Rows.concatenate(told, first)
    after, narrow = Process(slow, np.append(logs, before[0] + 1.0), SCALES).predict(asked)
    assert (after > before).all(), "a slow measurement makes the whole device slower"
    assert (narrow < width).all()
    assert abs(after[0] - before[0] - 1.0) < 0.1, "the measured row itself is believed"
    faster, _ = Process(slow, np.append(logs, before[0] - 1.0), SCALES).predict(asked)
    assert (faster < before).all()


def test_far_from_all_data_the_roofline_is_left() -> None:
    told = rows(30, 7)
    local = replace(SCALES, constant=1e-9, all_m=1e-9)
    lonely = rows(3, 8, **dict.fromkeys(KEYS, 99))
    mean, deviation = Process(told, measured(told), local).predict(lonely)
    np.testing.assert_allclose(mean, lonely.prior, atol=1e-9)
    np.testing.assert_allclose(deviation**2, np.diag(kernel(lonely, lonely, local)) + local.noise**2)


def test_a_noisy_measurement_counts_less() -> None:
    told = rows(1, 10)
    logs = told.prior + 1.0
    sharp, dull = (Process(told, logs, SCALES, np.array([noise])).joint(told)[0] - told.prior for noise in (0.01, 3.0))
    assert 0 < dull[0] < sharp[0] < 1.0


@pytest.mark.parametrize("count", [1, 64, 200])
def test_mean_and_covariance_are_those_of_the_textbook(count: int) -> None:
    told, asked = rows(count, 13), rows(5, 14)
    logs = told.prior + np.random.default_rng(count).normal(size=count)
    inverse = np.linalg.inv(kernel(told, told, SCALES) + SCALES.noise**2 * np.eye(count))
    across = kernel(told, asked, SCALES)
    mean, covariance = Process(told, logs, SCALES).joint(asked)
    np.testing.assert_allclose(mean, asked.prior + across.T @ inverse @ (logs - told.prior), atol=1e-9)
    np.testing.assert_allclose(covariance, kernel(asked, asked, SCALES) - across.T @ inverse @ across, atol=1e-9)


def test_rows_are_joined_and_taken_in_order() -> None:
    first, second = rows(3, 11), rows(2, 12)
    both = Rows.concatenate(first, second)
    assert len(both) == 5
    np.testing.assert_array_equal(both.take(slice(3, 5)).model, second.model)
    np.testing.assert_array_equal(both.take([0]).keys["pair"], first.keys["pair"][:1])
