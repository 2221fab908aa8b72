"""The control: labels are exchanged, so that nothing but their distribution is left of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vlatool.episodes.frames import file_of
from vlatool.errors import DataError
from vlatool.training.control import exchange_labels, other_rows

SEED = (0, 1)


@pytest.mark.parametrize("count", [2, 3, 5, 1000])
def test_every_row_gets_another_one_and_each_is_used_once(count: int):
    others = other_rows(count, SEED)
    assert sorted(others) == list(range(count))
    assert not (others == np.arange(count)).any()
    assert others.tolist() == other_rows(count, SEED).tolist()


@pytest.mark.parametrize("count", [0, 1])
def test_without_another_row_there_is_no_control(count: int):
    with pytest.raises(DataError, match=f"of another one; there is {count}"):
        other_rows(count, SEED)


def test_labels_change_places_together_and_nothing_else_does(tmp_path: Path):
    """More rows than are copied at a time; two outputs of one row stay together."""
    count = 600
    arrays = {"x": np.arange(count), "teacher.action": np.arange(count) * 10.0, "teacher.value": np.arange(count) * 7}
    for name, values in arrays.items():
        np.save(file_of(tmp_path, name), values)
    exchange_labels(tmp_path, ["action", "value"], SEED)
    found = {name: np.load(file_of(tmp_path, name)) for name in arrays}
    assert found["x"].tolist() == arrays["x"].tolist()
    assert sorted(found["teacher.action"]) == arrays["teacher.action"].tolist()
    assert not (found["teacher.action"] == arrays["teacher.action"]).any()
    assert (found["teacher.action"] * 7 == found["teacher.value"] * 10).all()
    assert found["teacher.value"].dtype == arrays["teacher.value"].dtype
    assert len(list(tmp_path.iterdir())) == 3
