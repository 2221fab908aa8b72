"""Actions that arrive late: what is done meanwhile, and which actions of the new chunk are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import UsageError
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.control.late import LateController, hold


def played(
    mode: str, chunk: int, execute: int, delay: int, steps: int
) -> tuple[list[float], NumberedPolicy, list[bool]]:
    policy = NumberedPolicy(spec_of(chunk, action=replace(MOVES, mode=mode)))
    controller = LateController(policy, execute, delay=delay)
    taken = [(float(controller.act({"t": t})[0]), controller.fresh) for t in range(steps)]
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


@pytest.mark.parametrize(("chunk", "execute"), [(1, 0), (4, 0), (4, 3), (8, 1)])
def test_without_a_delay_it_acts_as_a_queue_does(chunk: int, execute: int):
    queue, late = (made(NumberedPolicy(spec_of(chunk)), execute) for made in (ChunkQueue, LateController))
    for t in range(10):
        np.testing.assert_array_equal(queue.act({"t": t}), late.act({"t": t}))
        assert queue.fresh == late.fresh


def test_the_gripper_keeps_its_command_and_labels_are_repeated():
    np.testing.assert_array_equal(hold(MOVES, np.array([0.3, -1.0])), [0.0, -1.0])
    buttons = TensorSpec("a", (1, 3), kind="discrete", labels=("l", "r", "f"))
    assert hold(buttons, np.array(2)) == 2
    with pytest.raises(ValueError, match="no action to hold"):
        hold(MOVES, None)


def test_an_episode_begins_anew():
    policy = NumberedPolicy(spec_of(4, 2))
    controller = LateController(policy, delay=2)
    for t in range(3):
        controller.act({"t": t})
    controller.reset(7)
    assert policy.seeds == [7]
    assert float(controller.act({"t": 9})[0]) == 900


@pytest.mark.parametrize("delay", [-1, 0.5, True])
def test_a_delay_is_of_whole_steps(delay):
    with pytest.raises(UsageError, match=r"delay is .*; allowed: a whole number from 0"):
        LateController(NumberedPolicy(spec_of()), delay=delay)
