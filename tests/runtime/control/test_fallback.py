"""Every control step is answered: by the policy, or by the next rung that has an action."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from _fake_clock import FakeClock, FakeWorker, SlowPolicy
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DeadlineMissed, GraphError, UsageError
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.control.fallback import FallbackLadder
from vlatool.runtime.interface import CHUNK, FALLBACK, HOLD, POLICY, STOP, Controller
from vlatool.runtime.rungs import DECELERATE, ChunkRung, Hold, PolicyRung, Stop, neutral_index

PERIOD_S, LATE = 0.05, 1000.0
POSITIONS = TensorSpec("a", (1, 1, 2), labels=("x", "gripper"), mode="absolute")
SPEEDS = TensorSpec("a", (1, 1, 2), labels=("x", "gripper"), mode="velocity")


def built(delays_ms: list[float], *, chunk: int = 1, execute: int = 0, action: TensorSpec = POSITIONS,
          second: Any = None, hold_steps: int = 4, ramp: int = 1, **options: Any) -> Any:  # fmt: skip
    clock = FakeClock()
    policy = SlowPolicy(spec_of(chunk, execute, action), clock, delays_ms)
    player = ChunkQueue(Deadline(policy, 10.0, clock=clock, worker=FakeWorker(clock)), clock=clock)
    rungs: list[Any] = [ChunkRung(player), Hold(action, hold_steps, ramp=ramp), Stop(action, ramp=ramp)]
    if second is not None:
        rungs.insert(1, PolicyRung(second, FALLBACK))
    return policy, FallbackLadder(player, rungs, clock=clock, **options), clock


def play(ladder: FallbackLadder, clock: FakeClock, steps: int, first: int = 0) -> list[tuple[str, float]]:
    played = []
    for step in range(first, first + steps):
        clock.now = step * PERIOD_S
        action = ladder.act({"t": step})
        assert clock.now <= step * PERIOD_S + 0.0101, "every step is answered by the deadline"
        played.append((ladder.origin.source, float(np.asarray(action).reshape(-1)[0])))
    return played


def test_in_time_it_is_the_controller():
    _, ladder, clock = built([], chunk=2)
    assert isinstance(ladder, Controller)
    assert play(ladder, clock, 3) == [(POLICY, 0), (POLICY, 1), (POLICY, 200)]
    assert (ladder.fresh, ladder.rung, ladder.level, ladder.error) == (True, 0, 0, None)


def test_a_missed_step_is_bridged_by_the_rest_of_the_chunk_then_held_then_stopped():
    _, ladder, clock = built([0.0, *[LATE] * 9], chunk=3, execute=1, misses=100)
    played = play(ladder, clock, 9)
    assert played == [(POLICY, 0), (CHUNK, 1), (CHUNK, 2), *[(HOLD, 2)] * 4, *[(STOP, 2)] * 2]
    assert isinstance(ladder.error, DeadlineMissed)
    assert not ladder.fresh


def test_the_age_of_what_is_played_and_held_grows():
    _, ladder, clock = built([0.0, LATE, LATE, LATE], chunk=2, execute=1, misses=100)
    ages = []
    for step in range(4):
        play(ladder, clock, 1, step)
        ages.append(ladder.origin.age_ms)
    assert ages == pytest.approx([0, 60, 110, 160])


def test_a_chunk_that_is_too_old_is_not_used():
    _, ladder, clock = built([0.0, *[LATE] * 5], chunk=9, execute=1, misses=100)
    ladder.rungs[1] = ChunkRung(ladder.controller, max_age_ms=100.0)
    assert [source for source, _ in play(ladder, clock, 4)] == [POLICY, CHUNK, HOLD, HOLD]


def test_misses_among_the_last_steps_escalate_and_recovery_takes_several_in_a_row():
    delays = [0.0, LATE, 0.0, LATE, LATE, *[0.0] * 9]
    _, ladder, clock = built(delays, misses=3, window=5, recover=3, hold_steps=100)
    sources = [source for source, _ in play(ladder, clock, 10)]
    assert sources == [POLICY, HOLD, POLICY, HOLD, HOLD, HOLD, HOLD, POLICY, POLICY, POLICY]


def test_each_miss_begins_the_recovery_anew_and_a_recovered_policy_acts_on_what_it_sees():
    delays = [*[LATE] * 3, 0.0, 0.0, LATE, 0.0, 0.0, 0.0]
    policy, ladder, clock = built(delays, chunk=4, misses=3, recover=3, hold_steps=100, start=[7, 0])
    assert play(ladder, clock, 10) == [*[(HOLD, 7)] * 8, (POLICY, 800), (POLICY, 801)]
    assert policy.asked == list(range(9)), "each step of a recovery infers anew"


def test_few_misses_among_many_steps_do_not_escalate():
    _, ladder, clock = built([0.0, 0.0, LATE] * 20, misses=3, window=6)
    sources = [source for source, _ in play(ladder, clock, 60)]
    assert sources == [POLICY, POLICY, HOLD] * 20


class Second(NumberedPolicy):
    """Another policy: 10,000 and more; fails when it is told to."""

    fails = False

    def infer(self, observation: Any, *, noise: Any = None) -> Any:
        if self.fails:
            raise ConnectionError("the other machine does not answer")
        action = super().infer(observation)
        return action._replace(chunk=action.chunk + 10_000)


def test_a_second_policy_takes_over_and_gives_back():
    second = Second(spec_of(4, action=POSITIONS))
    _, ladder, clock = built([0.0, *[LATE] * 4, 0.0, 0.0], chunk=2, execute=1, misses=2, recover=2,
                             second=ChunkQueue(second))  # fmt: skip
    assert play(ladder, clock, 8) == [(POLICY, 0), (CHUNK, 1), (FALLBACK, 10_200), (FALLBACK, 10_201),
                                      (FALLBACK, 10_202), (FALLBACK, 10_203), (POLICY, 600), (POLICY, 700)]  # fmt: skip
    assert second.asked == [2]
    ladder.reset(3)
    assert second.seeds == [3]


def test_a_second_policy_that_is_asked_again_sees_what_is_there_then():
    second = Second(spec_of(9, action=POSITIONS))
    _, ladder, clock = built([0.0, LATE, 0.0, LATE], second=ChunkQueue(second), misses=100)
    assert [value for _, value in play(ladder, clock, 4)] == [0, 10_100, 200, 10_300]


def test_the_second_policy_recovers_before_the_first():
    second = Second(spec_of(1, action=POSITIONS))
    second.fails = True
    _, ladder, clock = built([0.0, *[LATE] * 99], misses=2, recover=2, hold_steps=100, second=ChunkQueue(second))
    assert {source for source, _ in play(ladder, clock, 6)[1:]} == {HOLD}
    assert ladder.level == 3
    second.fails = False
    assert [source for source, _ in play(ladder, clock, 3, 6)] == [HOLD, FALLBACK, FALLBACK]
    assert ladder.level == 2


@pytest.mark.parametrize(
    ("action", "ramp", "source", "held"),
    [(POSITIONS, 3, HOLD, [(100, 100.5)] * 4), (MOVES, 3, HOLD, [(0, 100.5)] * 4),
     (SPEEDS, 1, HOLD, [(0, 100.5)] * 4), (SPEEDS, 4, DECELERATE, [(75, 100.5), (50, 100.5), (25, 100.5), (0, 100.5)])],
)  # fmt: skip
def test_what_holding_means_depends_on_the_mode(action: TensorSpec, ramp: int, source: str, held: Any):
    _, ladder, clock = built([0.0, 0.0, *[LATE] * 9], action=action, ramp=ramp, misses=100)
    play(ladder, clock, 2)
    for step, wanted in enumerate([*held, held[-1]], 2):
        clock.now = step * PERIOD_S
        assert ladder.act({"t": step}).tolist() == list(wanted)
        assert ladder.origin.source == (source if step < 6 else STOP)


def test_a_velocity_slows_down_again_from_where_it_is():
    _, ladder, clock = built([0.0, 0.0, LATE, LATE, 0.0, LATE], action=SPEEDS, ramp=4, misses=100)
    assert [value for _, value in play(ladder, clock, 6)] == [0, 100, 75, 50, 400, 300]


def test_a_stop_can_be_latched():
    _, ladder, clock = built([0.0, *[LATE] * 3], misses=1, recover=1, hold_steps=2, latch=True)
    assert [source for source, _ in play(ladder, clock, 12)] == [POLICY, HOLD, HOLD, *[STOP] * 9]
    ladder.reset()
    assert play(ladder, clock, 1, 12) == [(POLICY, 1200)]


def test_without_an_action_to_hold_the_error_is_passed_on():
    _, ladder, _ = built([LATE])
    with pytest.raises(DeadlineMissed, match="no action within 10 ms"):
        ladder.act({"t": 0})
    _, ladder, clock = built([LATE], action=MOVES)
    assert play(ladder, clock, 2) == [(HOLD, 0), (POLICY, 100)]
    _, ladder, clock = built([LATE], start=[3, 1])
    assert play(ladder, clock, 1) == [(HOLD, 3)]


def test_whatever_the_policy_raises_is_answered():
    class Broken(SlowPolicy):
        errors: Any = ()

        def infer(self, observation: Any, *, noise: Any = None) -> Any:
            action = super().infer(observation)
            if observation["t"]:
                raise self.errors.pop(0)
            return action

    clock = FakeClock()
    policy = Broken(spec_of(1, action=POSITIONS), clock)
    policy.errors = [GraphError("nan"), ValueError("other"), ConnectionError(), ZeroDivisionError()]
    ladder = FallbackLadder(ChunkQueue(policy), clock=clock, misses=9)
    errors = []
    for step in range(5):
        assert ladder.act({"t": step}).tolist() == [0, 0.5]
        errors.append(type(ladder.error))
    assert errors == [type(None), GraphError, ValueError, ConnectionError, ZeroDivisionError]


def test_an_action_without_motion_is_needed_among_labels():
    names = ("left", "stop", "forward")
    buttons = TensorSpec("a", (1, 1, 3), kind="discrete", labels=names)
    assert neutral_index(buttons) == 1
    assert neutral_index(buttons, "left") == 0
    assert Hold(buttons).act({}, np.asarray(2)).tolist() == 1
    for labels, neutral in ((("left", "go", "on"), ""), (("stop", "wait", "go"), ""), (names, "halt")):
        other = TensorSpec("a", (1, 1, 3), kind="discrete", labels=labels)
        with pytest.raises(UsageError, match="of the labels of 'a' are"):
            Stop(other, neutral=neutral)


@pytest.mark.parametrize("wrong", [{"misses": 0}, {"window": 1.5}, {"recover": True}])
def test_numbers_that_are_none_are_refused(wrong: dict[str, Any]):
    with pytest.raises(UsageError, match="allowed"):
        FallbackLadder(ChunkQueue(NumberedPolicy(spec_of())), **wrong)


def test_many_steps_with_random_delays_are_all_answered_and_no_late_action_is_used():
    random = np.random.default_rng(0)
    delays = (random.random(4_000) ** 4 * 100).tolist()
    policy, ladder, clock = built(list(delays), chunk=3, execute=2, misses=3)
    late = {step for step, delay in zip(_asked(policy, ladder, clock, 4_000), delays, strict=False) if delay > 10}
    assert len(late) > 200


def _asked(policy: Any, ladder: FallbackLadder, clock: FakeClock, steps: int) -> list[int]:
    """Play, and return at which step each inference began; a chunk of a late one is never played."""
    began: list[int] = []
    infer, late = policy.infer, set()

    def noting(observation: Any, *, noise: Any = None) -> Any:
        began.append(observation["t"])
        before = clock.now
        action = infer(observation)
        if clock.now - before > 0.01:
            late.add(observation["t"])
        return action

    policy.infer = noting
    ladder._last = np.zeros(2, np.float32)
    for step in range(steps):
        clock.now = step * PERIOD_S
        action = ladder.act({"t": step})
        assert clock.now <= step * PERIOD_S + 0.0101
        if ladder.origin.source in (POLICY, CHUNK):
            assert int(action[0]) // 100 not in late
    return began
