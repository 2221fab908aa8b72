"""Events for TensorBoard, read by TensorBoard's own reader, and that they are no part of the bundle."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from _trainings import Killed, digest, distilled, killed_after, raise_killed, training_of

from vlatool.bundle.bundle import Bundle
from vlatool.stage.base import Context

pytestmark = pytest.mark.usefixtures("in_this_process")


def events(folder: Path) -> dict[str, dict[int, float]]:
    """Scalar name -> step -> value."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        read = EventAccumulator(str(folder))
        read.Reload()
    return {name: {event.step: event.value for event in read.Scalars(name)} for name in read.Tags()["scalars"]}


def test_every_step_and_every_look_are_there_also_after_a_kill(pruned_once: Bundle, tmp_path: Path):
    pytest.importorskip("tensorboard")
    whole = distilled(pruned_once, tmp_path / "whole", patience=5)
    context = Context(events=str(tmp_path / "new/events"))
    with killed_after(5, raise_killed), pytest.raises(Killed):
        distilled(pruned_once, tmp_path / "out", context, patience=5)
    made = distilled(pruned_once, tmp_path / "out", context, patience=5)
    told, training = events(tmp_path / "new/events"), training_of(made)
    assert list(told["loss"]) == list(range(1, 13))
    assert list(told["loss"].values()) == pytest.approx(training["losses"])
    assert max(told["learning rate"].values()) == pytest.approx(0.003)
    assert told["held-out loss"] == pytest.approx(dict(zip((3, 6, 9, 12), training["judged"]["scores"], strict=True)))
    assert (made.hash, digest(made)) == (whole.hash, digest(whole)), "events are no part of it"


def test_success_is_told(pruned_once: Bundle, tmp_path: Path):
    pytest.importorskip("tensorboard")
    options = {"episodes": 2, "student_episodes": 2, "steps": 4, "every": 2}
    made = distilled(pruned_once, tmp_path / "out", Context(events=str(tmp_path / "events")), **options)
    student = training_of(made)["rounds"][1]
    assert events(tmp_path / "events")["success"] == {2: student["successes"] / student["episodes"]}
