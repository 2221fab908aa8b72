from __future__ import annotations

import numpy as np
import pytest

from vlatool.stats import bootstrap
from vlatool.stats.bootstrap import resampled_sums


def test_each_resample_is_of_the_same_units_in_every_column() -> None:
    units = np.random.default_rng(0).normal(size=7)
    once, twice = resampled_sums((units, 2 * units), 50, np.random.default_rng(1))
    assert once.shape == (50,)
    np.testing.assert_array_equal(twice, 2 * once)
    assert len(set(once.tolist())) > 40


def test_units_are_drawn_with_replacement_as_many_as_there_are() -> None:
    ones, powers = np.ones(5), 10.0 ** np.arange(5)
    counts, drawn = resampled_sums((ones, powers), 200, np.random.default_rng(2))
    assert set(counts.tolist()) == {5.0}
    often = np.array([[int(digit) for digit in f"{int(total):05d}"] for total in drawn])
    assert set(often.sum(axis=1).tolist()) == {5}
    assert often.max() > 2
    assert often.mean(axis=0) == pytest.approx(np.ones(5), abs=0.25), "each as likely as the others"


@pytest.mark.parametrize("block", [1, 7, 10, 1 << 20])
def test_how_many_are_drawn_at_a_time_changes_nothing(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    units = np.random.default_rng(3).normal(size=7)
    (whole,) = resampled_sums((units,), 30, np.random.default_rng(4))
    monkeypatch.setattr(bootstrap, "BLOCK", block)
    np.testing.assert_array_equal(resampled_sums((units,), 30, np.random.default_rng(4))[0], whole)
