"""A kill of a training, two in the full form; ``tests/validation/soak/kill9_train.py`` makes as many as are wanted."""

from pathlib import Path

import pytest
from _full import small_or_full
from kill9_train import rounds, training


@pytest.mark.soak("kills within a training of each kind: tests/distill, tests/prune")
def test_a_killed_training_goes_on_to_the_same_bytes(tmp_path: Path):
    played = ["--episodes", "0", "--student-episodes", "0"]
    work = training(tmp_path, [*played, "--patience", "5", "--steps", "40", "--every", "8"])
    kills = small_or_full(1, 2)
    assert rounds(work, kills=kills, seed=3, tell=lambda _line: None) == []
    assert work.counts["killed"] == kills
    assert work.counts["rounds"] >= 1
