"""Actions that come late: what is done meanwhile, and which actions of the new chunk are left out."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.spec import TensorSpec
from vlatool.episodes.late import Late, held


class Numbered:
    """A policy whose chunks say when they were asked for: 100 t, 100 t + 1, ..."""

    def __init__(self, mode: str, chunk: int) -> None:
        self.spec = SimpleNamespace(action=TensorSpec("a", (1, chunk, 2), labels=("x", "gripper"), mode=mode))
        self.chunk, self.asked, self.resets = chunk, [], 0

    def infer(self, observation: Mapping[str, Any]) -> Any:
        self.asked.append(observation["t"])
        rows = 100.0 * observation["t"] + np.arange(self.chunk)
        return SimpleNamespace(chunk=np.column_stack([rows, rows + 0.5]))

    def stopped_after(self, _seconds: float) -> Any:
        return contextlib.nullcontext()

    def reset(self, seed: int | None = None) -> None:
        self.resets += 1


def played(mode: str, chunk: int, execute: int, late: int, steps: int) -> tuple[list[float], Numbered, list[bool]]:
    policy = Numbered(mode, chunk)
    actor = Late(SimpleNamespace(policy=policy, execute=execute), late)
    taken = [(float(actor.act({"t": t})[0]), actor.fresh) for t in range(steps)]
    return [action for action, _ in taken], policy, [fresh for _, fresh in taken]


def test_what_is_left_of_a_chunk_bridges_the_wait_and_the_next_one_begins_later():
    actions, policy, fresh = played("delta", 8, 4, 2, 12)
    assert policy.asked == [0, 4, 10], "asked when the executed part is used up; the first is waited for"
    assert actions == [0, 1, 2, 3, 4, 5, 402, 403, 404, 405, 406, 407]
    assert [t for t, is_fresh in enumerate(fresh) if is_fresh] == [0, 6]


def test_where_nothing_is_left_the_robot_stops_or_holds():
    actions, _, _ = played("delta", 2, 2, 3, 9)
    assert actions == [0, 1, 0, 0, 0, 200, 201, 0, 0]
    actions, _, _ = played("absolute", 2, 2, 3, 9)
    assert actions == [0, 1, 1, 1, 1, 200, 201, 201, 201]


def test_a_rest_that_is_too_short_is_taken_first():
    actions, _, _ = played("velocity", 3, 2, 3, 8)
    assert actions == [0, 1, 2, 0, 0, 201, 202, 0]


def test_the_gripper_keeps_its_command_and_labels_are_repeated():
    action = TensorSpec("a", (1, 1, 2), labels=("x", "gripper"), mode="delta")
    np.testing.assert_array_equal(held(action, np.array([0.3, -1.0])), [0.0, -1.0])
    buttons = TensorSpec("a", (1, 3), kind="discrete", labels=("l", "r", "f"))
    assert held(buttons, np.array(2)) == 2
    with pytest.raises(ValueError, match="nothing was done"):
        held(action, None)


def test_an_episode_begins_anew():
    policy = Numbered("delta", 4)
    actor = Late(SimpleNamespace(policy=policy, execute=2), 2)
    for t in range(3):
        actor.act({"t": t})
    actor.reset()
    assert policy.resets == 1
    assert float(actor.act({"t": 9})[0]) == 900
