"""Threads of the sinks: what one of them does reaches neither the control step nor another sink."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest
from _numbered import NumberedPolicy, spec_of

from vlatool.errors import UsageError
from vlatool.runtime.stack import build_stack
from vlatool.runtime.telemetry import Delivery, Telemetry
from vlatool.runtime.telemetry.writer import Turn


def test_every_sink_gets_every_record_in_order():
    one, other = [], []  # type: ignore[var-annotated]
    telemetry = Telemetry(one.append, other.append, period_s=60)
    for number in range(100):
        telemetry.put(number)
    assert telemetry.flush()
    assert one == other == list(range(100))
    assert telemetry.close()
    assert (telemetry.drop_count, telemetry.failure_count) == (0, 0)


def test_a_sink_that_blocks_delays_no_control_step_and_drops_are_counted():
    free, seen = threading.Event(), []  # type: ignore[var-annotated]
    telemetry = Telemetry(lambda record: free.wait(20), seen.append, size=50, period_s=0.001)
    stack = build_stack(NumberedPolicy(spec_of(2)), telemetry=telemetry)
    begin = time.thread_time()
    for step in range(200):
        stack.act({"t": step})
    assert time.thread_time() - begin < 1.0, "the clock of this thread alone: neighbours do not count"
    assert telemetry.outlets[1].flush(10)
    assert not telemetry.outlets[0].flush(0.01), "it is still blocked"
    taken = telemetry.outlets[1].reader
    assert (len(seen), taken.taken + taken.dropped) == (taken.taken, 200)
    free.set()
    assert telemetry.close(10)
    slow = telemetry.outlets[0].reader
    assert slow.taken + slow.dropped == 200
    assert slow.dropped >= 149, "one is in the sink, the ring holds 50"


def test_a_thread_that_blocks_in_its_turn_is_waited_for_once():
    turn, waits = Turn(0.3), []
    assert turn.take()
    for _ in range(3):
        begin = time.monotonic()
        assert not turn.take()
        waits.append(time.monotonic() - begin)
    assert waits[0] >= 0.29
    assert min(waits[1:]) < 0.2
    turn.end()
    assert turn.take()
    turn.end()


def test_a_sink_that_blocks_in_its_turn_holds_no_other_one_up():
    free, seen, blocks = threading.Event(), [], threading.Event()  # type: ignore[var-annotated]

    def blocked(record: Any) -> None:
        blocks.set()
        free.wait(20)

    telemetry = Telemetry(blocked, seen.append, period_s=0.01)
    telemetry.put(0)
    assert blocks.wait(10)
    for number in range(1, 100):
        telemetry.put(number)
    end = time.monotonic() + 10
    while len(seen) < 100 and time.monotonic() < end:
        time.sleep(0.005)
    assert seen == list(range(100))
    free.set()
    assert telemetry.close(10)


def test_a_blocked_sink_is_left_alone_at_the_end():
    free = threading.Event()
    stack = build_stack(NumberedPolicy(spec_of(2)), telemetry=Telemetry(lambda record: free.wait(20), period_s=0.001))
    stack.act({"t": 0})
    assert stack.telemetry is not None
    assert stack.telemetry.close(0.05) is False
    free.set()
    assert stack.telemetry.close(10)


def test_what_a_sink_raises_is_counted_with_its_reason():
    class Full:
        closed = 0

        def __call__(self, record: Any) -> None:
            raise OSError("no space left on device")

        def flush(self) -> None:
            raise ValueError("flush")

        def close(self) -> None:
            self.closed += 1

    sink, seen = Full(), []  # type: ignore[var-annotated]
    telemetry = Telemetry(sink, seen.append, period_s=60)
    for number in range(3):
        telemetry.put(number)
    assert telemetry.close(10)
    assert (sink.closed, seen) == (1, [0, 1, 2])
    assert telemetry.failure_count >= 4, "three records, and each time that they were to be written"
    assert telemetry.outlets[0].error == "ValueError: flush"


@pytest.mark.parametrize("wrong", [{"size": 0}, {"size": 2.5}, {"period_s": 0}, {"period_s": float("nan")}])
def test_a_number_out_of_its_range_is_refused(wrong: dict[str, Any]):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Telemetry(print, **wrong)


@pytest.mark.parametrize("wrong", ["log.jsonl", 5, ["x"]])
def test_a_sink_that_cannot_be_called_is_refused(wrong: Any):
    with pytest.raises(UsageError, match="allowed: a function"):
        Telemetry(wrong)


def test_what_is_sent_is_told_with_its_step():
    seen: list[Any] = []
    stack = build_stack(NumberedPolicy(spec_of(2)), telemetry=seen.append)
    stack.act({"t": 0}, sensed=time.monotonic() - 0.5)
    stack.note_delivery()
    stack.act({"t": 1})
    stack.close()
    assert [type(each).__name__ for each in seen] == ["TickRecord", "Delivery", "TickRecord"]
    assert isinstance(seen[1], Delivery)
    assert seen[1].step == 0
    assert seen[0].sensed_ms >= 500
    assert seen[2].sensed_ms is None
    np.testing.assert_allclose(sum(seen[0].parts_ms) + seen[0].waited_ms, seen[0].answer_ms, rtol=1e-9)
