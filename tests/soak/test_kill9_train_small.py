"""Two kills of a training; ``python tests/soak/kill9_train.py`` makes as many as are wanted."""

from pathlib import Path

from kill9_train import rounds, training


def test_a_killed_training_goes_on_to_the_same_bytes(tmp_path: Path):
    played = ["--episodes", "0", "--student-episodes", "0"]
    work = training(tmp_path, [*played, "--patience", "5", "--steps", "40", "--every", "8"])
    assert rounds(work, kills=2, seed=3, tell=lambda _line: None) == []
    assert work.counts["killed"] == 2
    assert work.counts["rounds"] >= 1
