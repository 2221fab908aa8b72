"""Which episode is shown, and what of it."""

from __future__ import annotations

import pytest

from vlatool.accuracy.episode_choice import differs_most, with_episode
from vlatool.accuracy.success_comparison import Outcome, success_row


def outcome(seed: int, success: bool = True, steps: int = 40, jerk: float = 1.0) -> Outcome:
    return Outcome("a", seed, success, steps, "", {"jerk": jerk}, {}, {"fresh": (1.0, 0.0), "action.x": (0.5, 0.25)})


ALIKE = [outcome(seed) for seed in range(5)]


@pytest.mark.parametrize(("own", "place"), [
    ([outcome(0), outcome(1, jerk=1.5), outcome(2, jerk=3.0), outcome(3), outcome(4)], 2),
    ([outcome(0), outcome(1, jerk=9.0), outcome(2), outcome(3, steps=55), outcome(4)], 3),
    ([outcome(0), outcome(1, steps=99), outcome(2), outcome(3), outcome(4, success=False)], 4),
    (ALIKE, 0),
])  # fmt: skip
def test_success_counts_before_steps_and_these_before_motion(own: list[Outcome], place: int):
    assert differs_most(ALIKE, own) == place


def test_the_row_holds_the_steps_and_how_it_ended():
    row = with_episode(success_row("int8", "subject", ALIKE), outcome(3, success=False))
    assert row.raw["episode.action.x"] == [0.5, 0.25]
    assert row.details["the episode that differs most"] == [{"task": "a", "seed": 3, "success": "no", "steps": 40}]
