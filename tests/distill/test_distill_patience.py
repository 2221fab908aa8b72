"""When a student stops getting better: the best weights are the result, in a run that was killed, too."""

from __future__ import annotations

from pathlib import Path

import pytest
from _trainings import Killed, digest, distilled, killed_after, raise_killed, training_of

from vlatool.bundle.bundle import Bundle
from vlatool.report import read_report
from vlatool.training.session import Session

pytestmark = pytest.mark.usefixtures("in_this_process")
PLAYED = {"episodes": 2, "student_episodes": 2, "steps": 40}


def test_a_training_that_gets_better_goes_to_its_end(pruned_once: Bundle, tmp_path: Path):
    made = distilled(pruned_once, tmp_path / "out", patience=1, learning_rate=0.001)
    judged = training_of(made)["judged"]
    assert judged["by"] == "held-out loss"
    assert judged["scores"] == sorted(judged["scores"], reverse=True)
    assert judged["best_step"] == len(training_of(made)["losses"]) == 12
    assert training_of(made)["rounds"][0]["observations"] == 20, "of 24 recorded, an episode of four is held out"


def test_the_report_beside_the_bundle_has_the_curve_and_the_time(pruned_once: Bundle, tmp_path: Path):
    one, other = (distilled(pruned_once, tmp_path / name, steps=3) for name in ("one", "other"))
    (row,) = read_report(one.path / "reports").rows
    assert row.raw["training: distill.policy"] == training_of(one)["losses"]
    assert row.value("training_time.distill.policy") > 0
    assert (one.path / "reports/report.html").is_file()
    assert one.hash == other.hash
    assert not [file for file in one.manifest.files if file.startswith("reports")], "times are not part of the hash"
    assert Bundle.open(one.path)


def test_it_stops_and_keeps_the_best_however_often_it_is_killed(
    pruned_once: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """With scores that the test gives, the fifth of which nobody should ask for."""
    scores = {1: 0.2, 2: 0.6, 3: 0.5, 4: 0.4}
    monkeypatch.setattr(Session, "_score", lambda _self, number: scores[number])
    whole = distilled(pruned_once, tmp_path / "whole", patience=2, steps=30)
    training = training_of(whole)
    assert training["judged"] == {"by": "held-out loss", "scores": [-0.2, -0.6, -0.5, -0.4], "best_step": 6}
    assert len(training["losses"]) == 12, "stopped at the fourth look of nine"
    for step in (2, 4, 7, 11, 12):
        with killed_after(step, raise_killed), pytest.raises(Killed):
            distilled(pruned_once, tmp_path / "killed", patience=2, steps=30)
    killed = distilled(pruned_once, tmp_path / "killed", patience=2, steps=30)
    assert digest(killed) == digest(whole)
    assert training_of(killed) == training


def test_success_in_the_student_s_episodes_decides_where_it_plays(pruned_once: Bundle, tmp_path: Path):
    """A student that never changes is as good in every round of the same kind: two more rounds, and it stops."""
    still = {**PLAYED, "learning_rate": 1e-9, "patience": 2, "noise": 0, "every": 4}
    made = distilled(pruned_once, tmp_path / "out", **still)
    training = training_of(made)
    shares = [each["successes"] / each["episodes"] for each in training["rounds"] if each["actor"] == "student"]
    assert training["judged"]["by"] == "success"
    assert training["judged"]["scores"] == shares
    best = max(shares)
    first = shares.index(best)
    assert len(shares) == first + 3 or len(training["losses"]) == 40
    assert training["judged"]["best_step"] == 4 * (
        1 + max(place for place, share in enumerate(shares) if share == best)
    )
