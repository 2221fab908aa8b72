"""Two bars that turn towards each other: no command, and no stop behind one, brings them nearer than they may be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from _two_arms import two_arms

from vlatool.errors import UsageError
from vlatool.runtime.envelope import Envelope, JointLimits, KeepApart, RobotLimits

PERIOD = 0.02
LIMITS = RobotLimits(
    "bars", tuple(JointLimits(name, "rad", -3.0, 3.0, (-2.0, 2.0), 10.0, 200.0) for name in ("a", "b"))
)
GRIPPER = LIMITS.plus(JointLimits("gripper", "m", 0.0, 1.0, command="range"))


def drive(envelope: Envelope, steps: int, ask: object) -> list[tuple[float, ...]]:
    sent = []
    for step in range(steps):
        envelope.step(ask(step, envelope.position), elapsed_s=PERIOD)
        sent.append(envelope.position)
    return sent


def towards(step: int, position: tuple[float, ...]) -> list[float]:
    return [position[0] - 0.035, position[1] - 0.035]


@pytest.mark.parametrize("reach", [None, (0.5, 0.5)])
def test_arms_that_approach_stop_before_the_distance(reach: tuple[float, ...] | None) -> None:
    distance = two_arms()
    envelope = Envelope(LIMITS, PERIOD, apart=KeepApart(distance, 0.15, reach))
    envelope.start([1.5, 1.5])
    sent = drive(envelope, 80, towards)
    least = distance(np.array(sent)).min()
    assert 0.15 <= least < 0.25  # it stops, and not far too early
    free = Envelope(LIMITS, PERIOD)
    free.start([1.5, 1.5])
    assert distance(np.array(drive(free, 80, towards))).min() < 0.15
    assert envelope.at_rest()


def test_random_commands_never_bring_the_arms_nearer() -> None:
    distance, random = two_arms(), np.random.default_rng(2)
    envelope = Envelope(LIMITS, PERIOD, apart=KeepApart(distance, 0.15, (0.5, 0.5)))
    envelope.start([1.0, 1.0])
    goals = random.uniform(-2.5, 2.5, (5, 2))

    def ask(step: int, position: tuple[float, ...]) -> list[float]:
        return [
            value + float(np.clip(goal - value, -0.038, 0.038))
            for value, goal in zip(position, goals[step // 50], strict=True)
        ]

    assert distance(np.array(drive(envelope, 250, ask))).min() >= 0.15 - 1e-6


class Forgetful(KeepApart):
    """Computes the distance at each step, whatever it knows."""

    def allows(self, *arguments: Any) -> bool:
        self._measured.clear()
        return super().allows(*arguments)


def test_a_distance_that_is_known_saves_time_and_changes_no_command() -> None:
    distance, calls = two_arms(), []

    def counted(positions: np.ndarray) -> np.ndarray:
        calls.append(len(positions))
        return distance(positions)

    paths, counts = [], []
    for kind in (KeepApart, Forgetful):
        random = np.random.default_rng(4)
        goals = random.uniform(-2.5, 2.5, (12, 2))
        goals[::3] = [[0.0, 0.0]] * 4  # towards each other
        envelope = Envelope(LIMITS, PERIOD, apart=kind(counted, 0.15, (0.5, 0.5)))
        envelope.start([1.0, 1.0])
        calls.clear()

        def ask(step: int, at: tuple[float, ...], goals: np.ndarray = goals) -> list[float]:
            steps = np.clip(goals[step // 50] - np.array(at), -0.038, 0.038)
            return (np.array(at) + steps).tolist()

        paths.append(drive(envelope, 600, ask))
        counts.append(len(calls))
    assert paths[0] == paths[1]
    assert counts[0] < 0.7 * counts[1]
    assert distance(np.array(paths[0])).min() < 0.25  # they did come near


def test_from_too_near_only_ways_apart_are_allowed() -> None:
    envelope = Envelope(LIMITS, PERIOD, apart=KeepApart(two_arms(), 0.15))
    envelope.start([0.0, 0.0])
    assert "apart" not in envelope.step([0.001, 0.001], elapsed_s=PERIOD).checks
    near = Envelope(LIMITS, PERIOD, apart=KeepApart(two_arms(), 0.15))
    near.start([0.1, 0.1])
    assert near.step([0.0999, 0.0999], elapsed_s=PERIOD).checks == ("apart",)
    assert near.position == (0.1, 0.1)


def test_a_gripper_goes_along() -> None:
    distance = two_arms()
    envelope = Envelope(GRIPPER, PERIOD, apart=KeepApart(lambda positions: distance(positions[:, :2]), 0.15))
    envelope.start([1.0, 1.0, 0.5])
    assert envelope.step([1.0, 1.0, 0.9], elapsed_s=PERIOD).command == (1.0, 1.0, 0.9)


def test_a_copy_goes_on_by_itself() -> None:
    envelope = Envelope(LIMITS, PERIOD)
    envelope.start([1.0, 1.0])
    drive(envelope, 5, towards)
    twin, position = envelope.copy(), envelope.position
    moved = drive(twin, 10, towards)
    assert envelope.position == position
    assert drive(envelope, 10, towards) == moved


def test_what_cannot_be_kept_is_refused() -> None:
    with pytest.raises(UsageError, match="minimum_m"):
        KeepApart(two_arms(), 0.0)
    with pytest.raises(UsageError, match="positions"):
        Envelope(LIMITS, PERIOD, mode="velocity", apart=KeepApart(two_arms(), 0.1))
