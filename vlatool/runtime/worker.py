"""A thread that runs one task at a time for a caller who waits until a deadline and no longer."""

from __future__ import annotations

import _thread
import contextlib
import functools
import os
import select
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any, Protocol

from vlatool.errors import UsageError
from vlatool.runtime.process_end import EXIT_S, close_at_exit

MOST_HANDLES = 1024
"""Descriptors below this are the only ones that ``select()`` takes."""


class Task(Protocol):
    """What a worker runs."""

    def begin(self) -> None:
        """Prepare to run, so that ``stop`` has an effect from now on."""

    def run(self) -> Any:
        """Return the result."""

    def stop(self) -> None:
        """Make ``run`` end early, if it can; called in another thread, once or more often."""

    def undo(self) -> None:
        """Take back what ``run`` did: it returned too late."""


class _EventSignal:
    """Wakes a thread that waits, without Python's lock being held meanwhile.

    A thread that is woken by the release of a ``Lock`` needs Python's lock at once, which the one that woke it still
    holds: on one core that is two more changes of the thread, 20 to 30 us. Writing to an eventfd gives it up before.

    Args:
        endless: Whether it is waited for without an end.
    """

    def __init__(self, *, endless: bool) -> None:
        self._handle = os.eventfd(0, os.EFD_CLOEXEC | (0 if endless else os.EFD_NONBLOCK))
        weakref.finalize(self, os.close, self._handle).atexit = False
        if self._handle >= MOST_HANDLES and not endless:
            raise OSError("select() takes no such descriptor")

    def send(self) -> None:
        """Wake the thread that waits, or the next one."""
        os.eventfd_write(self._handle, 1)

    def wait(self, seconds: float) -> bool:
        """Return whether it was sent within a time, now or earlier; all that was sent counts as once."""
        if not select.select((self._handle,), (), (), seconds)[0]:
            return False
        os.eventfd_read(self._handle)
        return True

    def wait_endlessly(self) -> None:
        """Return when it was sent, now or earlier; all that was sent counts as once."""
        os.read(self._handle, 8)  # goes on after a signal, which eventfd_read() does not


class _LockSignal:
    """The same where there is no eventfd."""

    def __init__(self) -> None:
        self._lock = _thread.allocate_lock()
        self._lock.acquire()

    def send(self) -> None:
        """Wake the thread that waits, or the next one."""
        with contextlib.suppress(RuntimeError):  # it was sent already
            self._lock.release()

    def wait(self, seconds: float) -> bool:
        """Return whether it was sent within a time, now or earlier."""
        return self._lock.acquire(True, seconds)

    def wait_endlessly(self) -> None:
        """Return when it was sent, now or earlier."""
        self._lock.acquire()


def _signal(*, endless: bool = False) -> _EventSignal | _LockSignal:
    """Return the faster signal that this process can have: it may have no eventfd, or no descriptor left for one.

    Args:
        endless: Whether it is waited for without an end.
    """
    try:
        return _EventSignal(endless=endless)
    except (AttributeError, OSError):
        return _LockSignal()


class Call:
    """One task on its way: who waits for it, and what became of it.

    Args:
        due: Time of the clock by which it has to end.
        left: Seconds until then, when it started.
    """

    def __init__(self, task: Task, due: float, left: float) -> None:
        self.task, self.due, self.left = task, due, left
        self.began = self.abandoned = self.in_time = self.ended = False
        self.result: Any = None
        self.error: BaseException | None = None

    def outcome(self) -> Any:
        """Return the result of a call that has ended.

        Raises:
            TimeoutError: when it ended too late; the task has no effect then.
            Exception: what the task raised.
        """
        if self.error is not None:
            raise self.error
        if not self.in_time:
            raise TimeoutError("it ended too late")
        return self.result


class _Desk:
    """What a worker and its thread share; the thread does not hold the worker, and ends when nobody does."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.lock = _thread.allocate_lock()
        self.call: Call | None = None
        self._clock = clock
        self._turn: object = None

    @functools.cached_property  # with the first thread: a process that was forked before shares them with nobody
    def wake_signal(self) -> _EventSignal | _LockSignal:
        """Sent when there is a call, or the thread is to end; also without either."""
        return _signal(endless=True)

    @functools.cached_property
    def end_signal(self) -> _EventSignal | _LockSignal:
        """Sent when a call has ended, perhaps one before that which is waited for."""
        return _signal()

    def begin_serving(self) -> Callable[[], None]:
        """Return what a thread is to do from now on; an earlier one ends after the call in progress."""
        self._turn = turn = object()
        wake = self.wake_signal

        def serve() -> None:
            while self._turn is turn:
                wake.wait_endlessly()
                if (call := self.call) is not None:
                    self._perform(call)

        return serve

    def leave(self) -> None:
        """End the thread, after the call in progress."""
        if self._turn is not None:
            self._turn = None
            self.wake_signal.send()

    def _perform(self, call: Call) -> None:
        with self.lock:
            if not call.abandoned:
                call.task.begin()
                call.began = True
        try:
            if call.began:
                call.result = call.task.run()
        except BaseException as error:  # the caller's thread raises it
            call.error = error
        with self.lock:
            call.in_time = not call.abandoned and self._clock() <= call.due
            if not call.in_time and call.began and call.error is None:
                call.task.undo()
                call.result = None
            self.call, call.ended = None, True
        self.end_signal.send()

    @property
    def busy(self) -> bool:
        """Whether a task is running."""
        return self.call is not None

    def abandon(self, call: Call) -> bool:
        """Give a call up unless it has ended; see ``Worker.abandon``."""
        with self.lock:
            if self.call is not call:
                return False
            call.abandoned = True
            if call.began:
                call.task.stop()
            return True

    def give_up(self, call: Call) -> None:
        """Abandon a call whose caller was interrupted, perhaps before its thread was woken."""
        if self.abandon(call):
            self.wake_signal.send()

    def end_call(self, seconds: float) -> None:
        """Stop the task that runs, and wait until it has ended, but no longer than this."""
        if (call := self.call) is not None:
            self.abandon(call)
            self.wait(call, seconds)

    def close(self, seconds: float = EXIT_S) -> None:
        """End the thread before Python shuts down, also where nobody has its worker any more."""
        self.end_call(seconds)
        self.leave()

    def wait(self, call: Call, seconds: float) -> bool:
        """Return whether a call ends within a time."""
        end = time.monotonic() + seconds
        while not call.ended and self.end_signal.wait(max(0.0, seconds)):
            seconds = end - time.monotonic()
        return call.ended


class Worker:
    """Runs tasks in one thread, which is started with the first and kept until the worker is closed or collected.

    A task that does not end by its time is stopped and taken back, and its result is never returned. One that cannot be
    stopped keeps the thread: the worker is then ``busy``, takes no other task, and starts no other thread. The thread
    is a daemon: it does not keep the process from ending.

    Args:
        name: Name of the thread.
        clock: Returns seconds.
    """

    def __init__(self, name: str = "vlatool-worker", clock: Callable[[], float] = time.monotonic) -> None:
        self._name, self._clock = name, clock
        self._desk = _Desk(clock)
        self._thread: threading.Thread | None = None
        weakref.finalize(self, self._desk.leave).atexit = False  # ``process_end`` waits for the thread

    @property
    def busy(self) -> bool:
        """Whether a task is running."""
        return self._desk.busy

    def call(self, task: Task, due: float) -> Any:
        """Return the result of a task that ends by a time of the clock.

        Raises:
            TimeoutError: when it does not, or an abandoned task still runs; the task has no effect then.
            UsageError: when another caller is waiting.
        """
        call = Call(task, due, due - self._clock())
        try:
            self._hand_over(call)
            in_time = self._desk.wait(call, call.left)
        except BaseException:  # Ctrl-C: nobody waits for it any more
            self._desk.give_up(call)
            raise
        if not in_time and self.abandon(call):
            raise TimeoutError("it was stopped")
        return call.outcome()

    def start(self, task: Task, due: float) -> Call:
        """Start a task beside the caller, who looks at the call until it has ended.

        Args:
            due: Time of the clock by which it has to end, or it has no effect; the caller abandons it then.

        Raises:
            TimeoutError, UsageError: as ``call`` does.
        """
        call = Call(task, due, due - self._clock())
        try:
            self._hand_over(call)
        except BaseException:
            self._desk.give_up(call)
            raise
        return call

    def _hand_over(self, call: Call) -> None:
        """Give the thread a call, or refuse it; where this is interrupted, the call is to be given up."""
        if self._thread is None and call.left > 0:
            self._start()
        with self._desk.lock:
            if self._desk.call is not None:
                self._refuse(self._desk.call)
            if call.left <= 0:
                raise TimeoutError("no time is left for it")
            self._desk.call = call
        self._desk.wake_signal.send()

    def wait(self, call: Call, seconds: float) -> bool:
        """Return whether a call ends within a time of the process's clock."""
        return self._desk.wait(call, seconds)

    def _refuse(self, call: Call) -> None:
        """Say why no task can be taken now; a task that should have ended is stopped again."""
        if not call.abandoned:
            raise UsageError("Another caller waits for this policy.", "open one policy for each thread")
        if call.began:
            call.task.stop()
        raise TimeoutError("one that was stopped before has not ended yet")

    def abandon(self, call: Call) -> bool:
        """Give a call up unless it has ended: its task is stopped, and has no effect; returns whether it was."""
        return self._desk.abandon(call)

    def _start(self) -> None:
        close_at_exit(self._desk)
        thread = threading.Thread(target=self._desk.begin_serving(), name=self._name, daemon=True)
        thread.start()
        self._thread = thread  # after the start: one that an interruption kept from starting serves nobody

    def close(self, seconds: float = EXIT_S) -> None:
        """End the thread; the next call starts another. A task that runs is stopped, and waited for so many seconds."""
        thread = self._thread
        self._desk.end_call(seconds)
        if not self.busy and thread is not None:
            self._thread = None
            self._desk.leave()
            thread.join()
