"""How long a training still takes, from a clock that the test turns."""

from __future__ import annotations

import pytest

from vlatool.training.forecast import Forecast, duration


class Clock:
    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


def test_it_counts_the_steps_of_this_run_and_the_pauses():
    clock = Clock()
    forecast = Forecast(steps=200, done=100, now=clock)
    clock.seconds += 50  # the first step is slow
    assert forecast.time_left(101) == ""
    for step in range(102, 124):
        clock.seconds += 2.0
        told = forecast.time_left(step)
    assert told == "3 min left", (200 - 123) * 2.0
    with forecast.pause():
        clock.seconds += 60
    clock.seconds += 2.0
    assert forecast.time_left(124) == "6 min left", "and the pauses that are to come"


@pytest.mark.parametrize(("seconds", "words"), [
    (0.4, "0 s"), (89.4, "89 s"), (90, "2 min"), (5399, "90 min"), (5400, "1.5 h"), (86400, "24.0 h"),
])  # fmt: skip
def test_durations(seconds: float, words: str):
    assert duration(seconds) == words
