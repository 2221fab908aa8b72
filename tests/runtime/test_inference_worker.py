"""A thread for one task at a time: what comes too late has no effect, and no second thread is started."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import threading
import time

import pytest

from vlatool.errors import UsageError
from vlatool.runtime import worker as workers
from vlatool.runtime.worker import MOST_HANDLES, Worker


class Steps:
    """A task that goes on until it is stopped or may end."""

    def __init__(self, result: object = 1, *, ends: bool = True, stops: bool = True) -> None:
        self.result, self.stops = result, stops
        self.done, self.running = threading.Event(), threading.Event()
        self.calls: list[str] = []
        self.thread = ""
        if ends:
            self.done.set()

    def begin(self) -> None:
        self.calls.append("begin")

    def run(self) -> object:
        self.thread = threading.current_thread().name
        self.running.set()
        self.done.wait(20)
        if isinstance(self.result, BaseException):
            raise self.result
        return self.result

    def stop(self) -> None:
        self.calls.append("stop")
        if self.stops:
            self.done.set()

    def undo(self) -> None:
        self.calls.append("undo")


@pytest.fixture(params=["eventfd", "lock"], autouse=True)
def way_to_wake(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Every test with both ways in which a thread is woken."""
    if request.param == "lock":
        monkeypatch.delattr(os, "eventfd")
    for endless in (False, True):
        signal_type = type(workers._signal(endless=endless)).__name__
        assert signal_type == {"eventfd": "_EventSignal", "lock": "_LockSignal"}[request.param]
    return str(request.param)


def soon(seconds: float = 10.0) -> float:
    return time.monotonic() + seconds


def free(worker: Worker) -> bool:
    """Whether the worker gets free."""
    end = soon()
    while worker.busy and time.monotonic() < end:
        time.sleep(0.001)
    return not worker.busy


def test_results_and_errors_come_from_one_thread_that_is_kept():
    worker, tasks = Worker("w"), [Steps(number) for number in range(3)]
    assert [worker.call(task, soon()) for task in tasks] == [0, 1, 2]
    assert {task.thread for task in tasks} == {"w"}
    assert [task.calls for task in tasks] == [["begin"]] * 3
    with pytest.raises(KeyError, match="x"):
        worker.call(Steps(KeyError("x")), soon())
    assert worker.call(Steps(4), soon()) == 4
    assert [thread.name for thread in threading.enumerate()].count("w") == 1
    worker.close()
    assert worker.call(Steps(5), soon()) == 5, "it starts again"
    worker.close()


@pytest.mark.parametrize("result", [1, KeyError("too late, too")])
def test_what_does_not_end_in_time_is_stopped_and_taken_back(result: object):
    worker, task = Worker(), Steps(result, ends=False)
    with pytest.raises(TimeoutError, match="it was stopped"):
        worker.call(task, soon(0.2))
    assert free(worker)
    assert task.calls == ["begin", "stop", "undo"][: 3 if result == 1 else 2]
    assert worker.call(Steps(2), soon()) == 2
    worker.close()


def test_what_cannot_be_stopped_is_not_waited_for_and_no_thread_is_added():
    worker, task = Worker("stuck"), Steps(ends=False, stops=False)
    with pytest.raises(TimeoutError, match="it was stopped"):
        worker.call(task, soon(0.02))
    for _ in range(5):
        with pytest.raises(TimeoutError, match="has not ended yet"):
            worker.call(Steps(), soon())
    assert worker.busy
    assert [thread.name for thread in threading.enumerate()].count("stuck") == 1
    assert task.calls == ["begin", *["stop"] * 6], "it is stopped again and again"
    task.done.set()
    assert free(worker)
    assert task.calls[-1] == "undo"
    assert worker.call(Steps(3), soon()) == 3
    worker.close()


def test_without_time_nothing_begins():
    worker, task = Worker(), Steps()
    with pytest.raises(TimeoutError, match="no time is left"):
        worker.call(task, time.monotonic())
    assert task.calls == []


def test_what_ends_after_its_time_is_not_returned_even_if_the_caller_wakes_late():
    times = [0.0, 2.0]
    worker, task = Worker(clock=lambda: times.pop(0)), Steps()
    with pytest.raises(TimeoutError, match="it ended too late"):
        worker.call(task, 1.0)
    assert task.calls == ["begin", "undo"]
    worker.close()


def test_two_callers_at_once_are_refused():
    worker, task = Worker(), Steps(ends=False)
    first = threading.Thread(target=lambda: worker.call(task, soon()))
    first.start()
    assert task.running.wait(10)
    with pytest.raises(UsageError, match="Another caller waits"):
        worker.call(Steps(), soon())
    task.done.set()
    first.join()
    worker.close()


def test_a_caller_who_is_interrupted_gives_the_task_up():
    worker, task = Worker(), Steps(ends=False)
    run, caller = task.run, threading.get_ident()

    def interrupting() -> object:
        signal.pthread_kill(caller, signal.SIGUSR1)
        return run()

    def interrupt(*_: object) -> None:
        raise InterruptedError

    task.run = interrupting  # type: ignore[method-assign]
    before = signal.signal(signal.SIGUSR1, interrupt)
    try:
        with pytest.raises(InterruptedError):
            worker.call(task, soon())
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert free(worker)
    assert task.calls == ["begin", "stop", "undo"]
    worker.close()


@pytest.mark.parametrize("way", ["call", "start"])
def test_a_caller_who_is_interrupted_before_the_wait_gives_the_task_up(way: str, monkeypatch: pytest.MonkeyPatch):
    """Python runs a handler of signals before the next line: the task may run before the caller looks at it."""
    worker, task = Worker(), Steps(ends=False)
    assert worker.call(Steps(1), soon()) == 1
    send = worker._desk.wake_signal.send

    def interrupted() -> None:
        send()
        assert task.running.wait(10)
        raise InterruptedError

    monkeypatch.setattr(worker._desk.wake_signal, "send", interrupted)
    with pytest.raises(InterruptedError):
        getattr(worker, way)(task, soon())
    monkeypatch.undo()
    assert free(worker)
    assert task.calls == ["begin", "stop", "undo"]
    assert worker.call(Steps(2), soon()) == 2
    worker.close()


def test_closing_stops_what_runs_and_waits_for_its_end():
    worker, task = Worker("closing"), Steps(ends=False)
    with pytest.raises(TimeoutError):
        worker.call(Steps(ends=False, stops=False), time.monotonic() - 1)

    def wait() -> None:
        with pytest.raises(TimeoutError):
            worker.call(task, soon(0.5))

    caller = threading.Thread(target=wait)
    caller.start()
    assert task.running.wait(10)
    worker.close()
    caller.join()
    assert task.calls == ["begin", "stop", "undo"]
    assert not worker.busy
    assert "closing" not in [thread.name for thread in threading.enumerate()]


def gone(thread: threading.Thread) -> bool:
    thread.join(10)
    return not thread.is_alive()


@pytest.mark.parametrize("busy", [False, True])
def test_the_thread_of_a_worker_that_nobody_holds_ends(busy: bool):
    worker, task = Worker("forgotten"), Steps(ends=False, stops=False)
    assert worker.call(Steps(), soon()) == 1
    if busy:
        with pytest.raises(TimeoutError):
            worker.call(task, soon(0.01))
    (thread,) = [each for each in threading.enumerate() if each.name == "forgotten"]
    del worker
    task.done.set()
    assert gone(thread), "without a collection of garbage, since frozen objects are never collected"


def test_a_worker_that_was_closed_is_collected_without_a_word(capfd: pytest.CaptureFixture[str]):
    worker = Worker("closed")
    for _ in range(2):
        worker.call(Steps(), soon())
        worker.close()
    del worker
    assert capfd.readouterr().err == ""


def test_a_signal_of_a_call_that_nobody_waited_for_ends_no_later_one():
    worker, late = Worker("w"), Steps("late")
    assert worker.call(Steps(0), soon()) == 0
    for _ in range(3):
        worker._desk.end_signal.send()
    late.done.clear()
    threading.Timer(0.05, late.done.set).start()
    assert worker.call(late, soon()) == "late"
    worker._desk.end_signal.send()
    with pytest.raises(TimeoutError, match="stopped"):
        worker.call(Steps(ends=False), soon(0.02))
    assert free(worker)
    assert worker.call(Steps(5), soon()) == 5


def test_neither_a_needless_wake_up_nor_a_signal_ends_the_thread():
    worker, first, last = Worker("w"), Steps(1), Steps(2)
    assert worker.call(first, soon()) == 1
    (thread,) = [each for each in threading.enumerate() if each.name == "w"]
    before = signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        for _ in range(3):
            worker._desk.wake_signal.send()
            signal.pthread_kill(thread.ident or 0, signal.SIGUSR1)
            time.sleep(0.02)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert thread.is_alive()
    assert worker.call(last, soon()) == 2
    assert [each for each in threading.enumerate() if each.name == "w"] == [thread]
    worker.close()
    assert not thread.is_alive()


FORKED = """
import os, sys, time
if sys.argv[1] == "lock":
    del os.eventfd
from vlatool.runtime.worker import Worker

class Nothing:
    begin = stop = undo = lambda self: None
    run = lambda self: os.getpid()

worker = Worker()
child = os.fork()
same = all(worker.call(Nothing(), time.monotonic() + 20) == os.getpid() for _ in range(2000))
worker.close()
if not child:
    os._exit(0 if same else 3)
sys.exit(0 if same and os.waitpid(child, 0)[1] == 0 else 4)
"""


def test_a_process_that_was_forked_before_the_first_call_wakes_its_own_thread(way_to_wake: str):
    """Processes that shared the signals would wake each other's threads instead: calls would end too late."""
    done = subprocess.run([sys.executable, "-c", FORKED, way_to_wake], timeout=100, check=False)
    assert done.returncode == 0


COUNTED = """
import gc, os, sys, time
if sys.argv[1] == "lock":
    del os.eventfd
from vlatool.runtime.worker import Worker

class Nothing:
    begin = stop = undo = run = lambda self: None

before = len(os.listdir("/proc/self/fd"))
for _ in range(20):
    worker = Worker()
    worker.call(Nothing(), time.monotonic() + 20)
    worker.close()
del worker
gc.collect()
print(len(os.listdir("/proc/self/fd")) - before)
"""


def test_descriptors_are_given_back(way_to_wake: str):
    """In a process of its own: threads of other tests give theirs back when they end."""
    done = subprocess.run([sys.executable, "-c", COUNTED, way_to_wake], capture_output=True, text=True, timeout=100)
    assert (done.stdout, done.stderr) == ("0\n", "")


def test_a_process_without_low_descriptors_has_workers_too(way_to_wake: str):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard <= MOST_HANDLES + 10:
        pytest.skip("this process may not have so many descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, MOST_HANDLES + 100), hard))
    taken = [os.dup(0) for _ in range(MOST_HANDLES)]
    try:
        assert Worker("w").call(Steps(3), soon()) == 3
    finally:
        for handle in taken:
            os.close(handle)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
