"""A control loop in a time that tests make: what each tick gets."""

import pytest

from vlatool.benchmark._paced import paced_measurements, run_paced


class Loop:
    """A clock, and a policy whose inferences take so many milliseconds each."""

    def __init__(self, *taken_ms, late_ms=0.0):
        self.now, self.taken, self.late, self.calls, self.resets = 100.0, taken_ms, late_ms, 0, 0

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds + self.late / 1e3

    def infer(self, observation):
        self.now += self.taken[self.calls % len(self.taken)] / 1e3
        self.calls += 1
        return type("Action", (), {"outputs": {}})

    def reset(self):
        self.resets += 1

    def run(self, ticks, rate=100.0, **more):
        return run_paced(self, [{}, {}], rate, ticks, clock=self.clock, sleep=self.sleep, **more)


def test_a_fast_policy_answers_every_tick_in_time():
    loop = Loop(3.0)
    found = loop.run(10)
    assert list(found.response_ms) == pytest.approx([3.0] * 10)
    assert list(found.wakeup_ms) == pytest.approx([0.0] * 10, abs=1e-6)
    assert list(found.age_ms) == pytest.approx([10.0] * 9)
    assert (found.misses, found.passed_over, loop.resets) == (0, 0, 5)
    assert [second - first for first, second in zip(found.due_s, found.due_s[1:], strict=False)] == pytest.approx(
        [0.01] * 9
    )


def test_lateness_counts_from_the_tick():
    found = Loop(3.0, late_ms=0.5).run(4)
    assert list(found.response_ms) == pytest.approx([3.5] * 4)
    assert list(found.wakeup_ms) == pytest.approx([0.5] * 4)
    assert list(found.age_ms) == pytest.approx([9.5] * 3), "the observation is taken when the loop wakes up"


def test_one_stall_hits_every_tick_that_it_covers():
    found = Loop(*[1.0] * 4, 52.0, *[1.0] * 5).run(10)
    # the tick of the stall waits 52 ms; the four after it are passed over until the newest, which begins 2 ms late
    assert list(found.response_ms) == pytest.approx([1, 1, 1, 1, 52, 43, 33, 23, 13, 3])
    assert (found.misses, found.passed_over) == (5, 4)
    assert max(found.age_ms) == pytest.approx(60.0), "the last tick that the stall covers has an action 60 ms old"


def test_a_policy_that_is_too_slow_for_the_rate_is_late_at_every_tick():
    found = Loop(25.0).run(100)
    assert found.misses == 100
    assert len(found.response_ms) == 100
    assert found.passed_over > 50


def test_progress_is_told_now_and_then():
    told = []
    Loop(1.0).run(120, tell=lambda what, share: told.append((what, share)))
    assert told == [("serving ticks at 100 Hz", 50 / 120), ("serving ticks at 100 Hz", 100 / 120)]


def test_the_numbers_of_a_loop():
    found = {each.name: each for each in paced_measurements(Loop(*[1.0] * 9, 52.0).run(1000).to_dict(), 1000, 100.0)}
    assert set(found) == {"deadline_misses", "age_p50", "age_p99", "age_max", "wakeup_p50", "wakeup_p99"}
    misses = found["deadline_misses"]
    assert misses.low < misses.value < misses.high
    assert misses.value == pytest.approx(5 / 14, abs=0.01)
    assert "passed over" in misses.note
    assert found["age_max"].value == pytest.approx(60)
