"""Rows on the disk, in rounds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vlatool.episodes.frames import file_of
from vlatool.errors import DataError
from vlatool.training.frames import Frames, concatenate
from vlatool.training.rounds import next_round


def part(folder: Path, values: list[int]) -> Path:
    folder.mkdir(parents=True)
    for name, dtype in (("a/b", np.int64), ("c", np.float32)):
        np.save(file_of(folder, name), np.array(values, dtype)[:, None])
    return folder


def test_parts_are_joined_and_rows_found_over_all_rounds(tmp_path: Path):
    frames = Frames(tmp_path)
    first, second = part(tmp_path / "p", [1, 2]), part(tmp_path / "q", [3])
    next_round(frames, 0, lambda target: concatenate((first, tmp_path / "none", second), target))
    next_round(frames, 1, lambda target: concatenate((part(tmp_path / "r", [4, 5]),), target))
    assert len(frames) == 5
    rows = frames.batch(np.array([4, 0, 2, 3]))
    assert rows["a/b"].tolist() == [[5], [1], [3], [4]]
    assert rows["c"].dtype == np.float32


def test_a_round_that_is_whole_is_not_written_again_and_a_draft_is(tmp_path: Path):
    def fails(target: Path) -> None:
        part(target / "x", [1])
        raise OSError("killed")

    frames = Frames(tmp_path)
    with pytest.raises(OSError, match="killed"):
        next_round(frames, 0, fails)
    assert not frames.has(0)
    next_round(frames, 0, lambda target: concatenate((part(target / "x", [7]),), target))
    again = Frames(tmp_path)
    next_round(again, 0, fails)
    assert again.batch(np.array([0]))["c"].tolist() == [[7.0]]


def test_nothing_to_train_on_is_an_error(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no observations to train on"):
        concatenate((tmp_path / "empty", tmp_path / "none"), tmp_path)
