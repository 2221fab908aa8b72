"""The small form of ``reach_policies.py``: its verdict, and where the models are installed, some hostile ticks."""

from __future__ import annotations

import pytest
from _full import small_or_full
from reach_policies import WORLDS, Outcome, attack

from vlatool.errors import MissingExtra
from vlatool.worlds import open_world


def right() -> Outcome:
    found = {"position": 0.0, "velocity": 0.0, "gripper": 0.01}
    return Outcome("aloha", 100.0, [3.0] * 95 + [30.0] * 5, True, dict(found), dict(found), 1000, 0.06, ([0.2], [0.9]))


def test_what_is_right_is_right() -> None:
    assert right().wrong() == []
    assert right().lines()["within 2 cm"].startswith("95 of 100")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"training_s": 301.0}, "training took too long"),
        ({"distances_mm": [3.0] * 94 + [20.1] * 6}, "too few episodes"),
        ({"same_motion": False}, "another order"),
        ({"in_episodes": {"position": 2e-6}}, "left its limits"),
        ({"in_attacks": {"velocity": 2e-6}}, "left its limits"),
        ({"apart_m": 0.049}, "too near"),
        ({"tick_ms": ([0.2], [1.1])}, "step took too long"),
    ],
)
def test_what_is_wrong_is_named(change: dict[str, object], words: str) -> None:
    outcome = right()
    vars(outcome).update(change)
    (found,) = outcome.wrong()
    assert words in found


@pytest.mark.parametrize("name", WORLDS)
def test_hostile_ticks_take_no_simulated_joint_out_of_its_limits(name: str) -> None:
    try:
        open_world(WORLDS[name])
    except MissingExtra as error:
        pytest.skip(f"{error.message} (test_arms.py covers the controllers without a simulation)")
    outcome = Outcome(name, 0.0)
    attack(outcome, small_or_full(200, 10_000), "")
    assert outcome.ticks == small_or_full(200, 10_000)
    outcome.tick_ms = ([], [])  # those of a busy machine
    assert outcome.wrong() == []
