"""What the table of ``arm64.py`` says about the layers around a policy."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _stack_rows import WANTED, compared_stacks
from _stack_serving import answered, apart, board_serves, serving_rows
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


def test_a_bundle_served_on_this_host_answers_what_it_answers_here(tmp_path: Path):
    rows = serving_rows(WHERE, Path(sys.executable), tmp_path / "arm")
    assert [(row.verdict, row.difference) for row in rows] == [(RIGHT, apart(np.ones(1), np.ones(1)))] * 7
    seen, command = np.zeros((2, 7), np.float32), [sys.executable, "-m", "vlatool"]
    with board_serves(command, tmp_path / "arm") as (addresses, _):
        assert [answered(each, addresses[each], seen, np.ones((2, 3, 7))).worst for each in ("openpi", "gr00t")] == [
            1,
            1,
        ]


@pytest.mark.parametrize("script", ["echo openpi: ws://127.0.0.1:1", "exit 0", "kill -9 $$"])
def test_what_does_not_serve_is_a_row(script: str, tmp_path: Path):
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(0o755)
    (row,) = serving_rows(WHERE, python, tmp_path / "arm")
    assert row.verdict == WRONG
    assert "does not serve" in row.note


def test_served_actions_that_differ_or_are_no_numbers_are_wrong():
    chunks = np.ones((2, 3, 7))
    assert apart(chunks, chunks).within(0)
    assert not any(apart(other, chunks).within(0) for other in (chunks + 1e-7, chunks[:1], chunks * np.nan))
