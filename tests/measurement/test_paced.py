"""A control loop in a time that tests make: what each tick gets."""

from dataclasses import replace

import pytest

from vlatool.measurement.interleaved import latency_measurements
from vlatool.measurement.paced import is_overloaded, paced_measurements, run_paced


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
    assert [what for what, _ in told] == ["serving ticks at 100 Hz"] * 2, "at once, and every second"
    assert [share for _, share in told] == pytest.approx([0, 100 / 120], abs=0.01)


def test_the_numbers_of_a_loop():
    found = {each.name: each for each in paced_measurements(Loop(*[1.0] * 999, 32.0).run(3000).pace(), 3000, 100.0)}
    assert set(found) == {"deadline_misses", "age_p50", "age_p99", "age_max", "wakeup_p50", "wakeup_p99"}
    misses = found["deadline_misses"]
    assert misses.low < misses.value < misses.high
    assert misses.value == pytest.approx(2 * 3 / 3000, abs=0.001)
    assert "passed over" in misses.note
    assert found["age_max"].value == pytest.approx(40)


def test_percentiles_of_few_ticks_are_refused_with_what_they_would_take():
    found = {each.name: each for each in paced_measurements(Loop(1.0).run(300).pace(), 300, 100.0)}
    for name in ("age_p99", "wakeup_p99"):
        assert not found[name].known
        assert "needs 662 independent calls" in found[name].note
        assert "(about 8 s)" in found[name].note, "at the rate of the loop, not back to back"
    assert found["age_p50"].high >= found["age_p50"].value
    assert found["age_p50"].confidence == 0.99


def test_nothing_is_bounded_where_many_ticks_share_an_inference():
    seen = Loop(25.0).run(1000).pace()
    assert seen.inferences < 600
    assert is_overloaded(seen, 1000)
    misses = paced_measurements(seen, 1000, 100.0)[0]
    assert (misses.value, misses.low, misses.high) == (1.0, None, None)
    wanted = latency_measurements([25.0] * 1000, refusals=True, most=0)
    assert [each.name for each in wanted if each.known] == ["latency_p50", "latency_max"]
    assert "lower --rate" in wanted[1].note


def test_a_loop_that_never_slept_says_nothing_of_waking_up():
    seen = Loop(25.0).run(50).pace()
    assert len(seen.wakeup_ms) <= 1
    assert not any(
        each.name.startswith("wakeup") for each in paced_measurements(replace(seen, wakeup_ms=()), 50, 100.0)
    )


def test_ticks_that_share_an_inference_count_for_less():
    seen = Loop(*[1.0] * 99, 52.0).run(300).pace()
    assert seen.effective_sample_size == pytest.approx(300**2 / (seen.inferences - 2 + 2 * 25), rel=0.1)


def test_there_is_time_for_other_things_while_the_loop_has_slack():
    called = []
    Loop(1.0).run(20, between=called.append)
    assert called == pytest.approx([tick / 20 for tick in range(1, 21)])
    Loop(25.0).run(20, between=lambda share: pytest.fail("no slack"))
