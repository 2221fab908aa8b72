"""What the table of ``arm64.py`` says about the layers around a policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from _stack_rows import WANTED, compared_stacks
from _verdicts import RIGHT, WRONG
from robot_stack import MODES, actions

WHERE = ("core", "1", "the stack")
HERE = {"actions a": np.ones((3, 2)), "commands b": np.ones((3, 2)), "excess": np.array([5e-10]), **WANTED}


def verdicts(there: dict[str, Any]) -> list[str]:
    return [row.verdict for row in compared_stacks(WHERE, HERE, there)]


def test_the_same_as_here_is_right():
    assert verdicts({**HERE, "actions a": HERE["actions a"] + 5e-7}) == [RIGHT] * 5


@pytest.mark.parametrize(
    ("name", "change"),
    [("actions a", lambda array: array + 1e-5), ("actions a", lambda array: array * np.nan),
     ("commands b", lambda array: array[:2]), ("commands b", lambda array: array + 1e-8),
     ("excess", lambda array: array + 1e-8), ("deadline", lambda array: array - 1),
     ("updates", lambda array: array[::-1])],
)  # fmt: skip
def test_anything_else_is_wrong(name: str, change: Callable[[Any], Any]):
    assert verdicts({**HERE, name: change(HERE[name])}).count(WRONG) == 1
    assert verdicts({key: value for key, value in HERE.items() if key != name}).count(WRONG) == 1


def test_what_both_count_wrongly_is_wrong():
    both = {**HERE, "updates": np.zeros(11)}
    assert [row.verdict for row in compared_stacks(WHERE, both, both)].count(WRONG) == 1


def test_the_actions_of_all_controllers_and_modes_are_the_same_each_time():
    one, other = dict(actions()), dict(actions())
    assert len(one) > 20
    assert {name.split()[-1] for name in one} == {*MODES}
    assert all(np.array_equal(one[name], other[name]) for name in one)
