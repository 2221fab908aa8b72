"""A student that fits what it has seen, and not what is new, is told apart from one that needs longer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.distill._trainings import Killed, distilled, killed_after, raise_killed, training_of
from vlatool.bundle.bundle import Bundle
from vlatool.training.device import CPU
from vlatool.training.frames import Frames
from vlatool.training.generalization_gap import (
    LOSS_KEY,
    MAX_ROWS,
    NEW_ROUND,
    PREVIOUS_ROUND,
    gap_lines,
    last_round_losses,
)

PLAYS = {"steps": 12, "every": 4, "episodes": 4, "student_episodes": 2, "threads": 1}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))


def rounds_of(folder: Path, *rounds: np.ndarray) -> Frames:
    frames = Frames(folder)
    for number, values in enumerate(rounds):
        np.save(frames.draft(number) / "x.npy", values)
        frames.keep(number)
        frames.read(number)
    return frames


def mean(rows: Any) -> torch.Tensor:
    return torch.from_numpy(rows["x"]).mean()


def test_the_losses_are_means_over_the_last_two_rounds(tmp_path: Path):
    first, second, third = (np.arange(size, dtype=np.float32) + 100 * size for size in (5, 7, 11))
    frames = rounds_of(tmp_path, first, second, third)
    assert frames.row_indices(1).tolist() == list(range(5, 12))
    losses = last_round_losses(frames, 2, mean, 4, CPU)
    assert losses == {
        NEW_ROUND: pytest.approx(float(third.mean())),
        PREVIOUS_ROUND: pytest.approx(float(second.mean())),
    }
    assert set(last_round_losses(rounds_of(tmp_path / "two", first, second), 1, mean, 4, CPU)) == {NEW_ROUND}


def test_of_a_long_round_some_rows_are_looked_at(tmp_path: Path):
    seen = []

    def loss(rows: Any) -> torch.Tensor:
        seen.extend(rows["x"].tolist())
        return mean(rows)

    frames = rounds_of(tmp_path, np.zeros(3, np.float32), np.arange(5000, dtype=np.float32))
    last_round_losses(frames, 1, loss, 100, CPU)
    assert len(seen) == MAX_ROWS
    assert (seen[0], seen[-1]) == (0, 4999)


@pytest.mark.parametrize(("losses", "told"), [
    ([], ()),
    ([{NEW_ROUND: 1.0}], ()),
    ([{NEW_ROUND: 1.0}, {NEW_ROUND: 0.1234567, PREVIOUS_ROUND: 0.1}],
     ("loss on new episodes of the student's 0.1235, on those before, trained on since, 0.1",)),
    ([{NEW_ROUND: 0.3, PREVIOUS_ROUND: 0.1}, {NEW_ROUND: 0.2, PREVIOUS_ROUND: 0.1}],
     ("loss on new episodes of the student's 0.2, on those before, trained on since, 0.1; more episodes may help "
      "(--episodes, --student-episodes)",)),
])  # fmt: skip
def test_more_episodes_are_advised_where_new_ones_are_harder(losses: list[dict[str, float]], told: tuple[str, ...]):
    assert gap_lines([{}, *({LOSS_KEY: each} for each in losses)]) == told


@pytest.mark.usefixtures("in_this_process")
def test_rounds_of_a_training_tell_both_and_a_kill_changes_nothing(pruned_once: Bundle, tmp_path: Path):
    made = distilled(pruned_once, tmp_path / "out", **PLAYS)
    rounds = training_of(made)["rounds"]
    assert [set(about.get(LOSS_KEY, {})) for about in rounds] == [set(), {NEW_ROUND}, {NEW_ROUND, PREVIOUS_ROUND}]
    assert all(loss > 0 for about in rounds for loss in about.get(LOSS_KEY, {}).values())
    assert "loss, not trained on" in (made.path / "reports/report.md").read_text()
    for step in (5, 9):
        with pytest.raises(Killed), killed_after(step, raise_killed):
            distilled(pruned_once, tmp_path / "again", **PLAYS, seed=step)
        resumed = distilled(pruned_once, tmp_path / f"again-{step}", **PLAYS, seed=step)
        whole = distilled(pruned_once, tmp_path / f"whole-{step}", **PLAYS, seed=step)
        assert training_of(resumed)["rounds"] == training_of(whole)["rounds"]
