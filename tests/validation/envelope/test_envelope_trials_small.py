"""The small form of ``envelope_trials.py``: each robot attacked, and its legal motions unchanged."""

from __future__ import annotations

import pytest
from _full import small_or_full
from envelope_trials import PROMISE, attacked, cases, legal

from vlatool.runtime.envelope import robot_names

CASES = [case for case in cases(robot_names()) if small_or_full(case[1] != "delta", True)]


@pytest.mark.parametrize(("name", "mode"), CASES)
def test_no_command_takes_a_robot_out_of_its_limits(name: str, mode: str):
    robot, worst = attacked(name, mode, small_or_full(400, 20_000), seed=3)
    assert max(worst.values()) <= PROMISE, worst
    assert len(robot.checks) > 5, "different checks bound the commands"


@pytest.mark.parametrize(("name", "mode"), CASES)
def test_legal_motions_pass_bit_for_bit(name: str, mode: str):
    steps, unchanged = legal(name, mode, small_or_full(300, 20_000), seed=3)
    assert unchanged == steps
