"""Calls that one thread stops at their deadlines."""

import os
import threading
import time
import warnings

import pytest

from vlatool.runtime.engines._deadlines import Watchdog

FAR = 3600.0


@pytest.fixture
def watchdog() -> Watchdog:
    return Watchdog()


def is_stopped(watchdog: Watchdog, after: float = 0.02) -> bool:
    """Whether a call that goes on beyond its deadline is stopped."""
    stopped = threading.Event()
    with watchdog.stopping(time.monotonic() + after, stopped.set):
        return stopped.wait(20)


def watching() -> int:
    return [thread.name for thread in threading.enumerate()].count("deadlines")


def test_one_thread_watches_all_calls(watchdog: Watchdog):
    before = watching()
    for number in range(50):
        with watchdog.stopping(time.monotonic() + FAR + number, lambda: None):
            assert watching() == before + 1


def test_an_earlier_deadline_counts_though_a_later_one_was_first(watchdog: Watchdog):
    stopped: list[str] = []
    with watchdog.stopping(time.monotonic() + FAR, lambda: stopped.append("later")):
        assert is_stopped(watchdog)
    assert is_stopped(watchdog), "and once more, though nothing is in progress until then"
    assert stopped == []


def test_a_call_that_has_ended_is_not_stopped(watchdog: Watchdog):
    stopped: list[str] = []
    with watchdog.stopping(time.monotonic() + 0.02, lambda: stopped.append("ended")):
        pass
    assert is_stopped(watchdog, 0.05)
    assert stopped == []


def test_the_thread_ends_when_nothing_is_in_progress_and_begins_again(watchdog: Watchdog):
    before = watching()
    for _ in range(2):
        assert is_stopped(watchdog)
        end = time.monotonic() + 20
        while watching() > before and time.monotonic() < end:
            time.sleep(0.005)
        assert watching() <= before, "those of earlier tests may end, too"


def test_a_limit_beyond_what_a_thread_can_wait_for_is_none(watchdog: Watchdog):
    with watchdog.stopping(float("inf"), lambda: None):
        assert is_stopped(watchdog)


def test_a_child_that_was_forked_has_a_thread_of_its_own():
    from vlatool.runtime.engines._deadlines import WATCHDOG

    with WATCHDOG.stopping(time.monotonic() + FAR, lambda: None), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # newer versions of Python warn of forks beside threads
        pid = os.fork()
        if pid == 0:
            os._exit(0 if is_stopped(WATCHDOG) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_where_no_thread_can_be_started_the_next_call_tries_again(monkeypatch: pytest.MonkeyPatch):
    watchdog, stopped = Watchdog(), threading.Event()

    def refuse(_self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        with pytest.raises(RuntimeError), watchdog.stopping(time.monotonic(), stopped.set):
            pass
    with watchdog.stopping(time.monotonic(), stopped.set):
        assert stopped.wait(10)
