"""Both sides of an action, without a transport: the server runs one goal at a time, of which the newest wins."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import NamedTuple

from vlatool.buses._interface import GOAL_ABORTED, GOAL_CANCELED, Goal, Outcome
from vlatool.errors import BusError
from vlatool.messages import Message


class _Entry(NamedTuple):
    identifier: str
    goal: Goal
    finished: Callable[[Outcome], None]
    started: Callable[[], None]


class Goals:
    """Runs the goals of an action one after another, in a thread of its own.

    Args:
        name: Name of the thread.
        result: Class of the results.
        handler: Runs a goal.
    """

    def __init__(self, name: str, result: type[Message], handler: Callable[[Goal], Outcome]) -> None:
        self._result, self._handler = result, handler
        self._changed = threading.Condition()
        self._waiting: list[_Entry] = []
        self._active: _Entry | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def add(
        self,
        identifier: str,
        message: Message,
        feedback: Callable[[Message], None],
        finished: Callable[[Outcome], None],
        started: Callable[[], None] = lambda: None,
    ) -> None:
        """Let a goal run as soon as that which runs has ended; it is canceled, and so are those that wait.

        Args:
            identifier: Name of the goal.
            message: The goal.
            feedback: Sends feedback.
            finished: Called with the outcome, once, in the thread of the goals.
            started: Called just before the goal runs.
        """
        entry = _Entry(identifier, Goal(message, feedback, threading.Event()), finished, started)
        with self._changed:
            for each in self._present():
                each.goal.canceled.set()
            self._waiting.append(entry)
            if self._closed:
                entry.goal.canceled.set()
            self._changed.notify_all()

    def cancel(self, identifier: str = "") -> bool:
        """Cancel a goal, or all; return whether there was one to cancel."""
        with self._changed:
            chosen = [each for each in self._present() if identifier in ("", each.identifier)]
            for each in chosen:
                each.goal.canceled.set()
            self._changed.notify_all()
        return bool(chosen)

    def close(self, timeout_s: float = 1.0) -> None:
        """Cancel every goal and wait until the handler has returned, for at most this many seconds."""
        with self._changed:
            self._closed = True
        self.cancel()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)

    def _present(self) -> list[_Entry]:
        return [*([self._active] if self._active else []), *self._waiting]

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if not self._waiting:
                    return
                self._active = entry = self._waiting.pop(0)
            outcome = self._outcome(entry)
            with self._changed:
                self._active = None
            entry.finished(outcome)

    def _outcome(self, entry: _Entry) -> Outcome:
        """Return how a goal ends; a goal that was canceled before its start does not run."""
        if entry.goal.canceled.is_set():
            return Outcome(GOAL_CANCELED, self._result())
        entry.started()
        try:
            return self._handler(entry.goal)
        except Exception:  # the client learns that its goal is over; who wrote the handler sees the traceback
            threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
            return Outcome(GOAL_ABORTED, self._result())


class AwaitedGoal:
    """The client's side of a goal whose outcome arrives by itself; see ``ClientGoal``.

    Args:
        action: Name of the action.
    """

    def __init__(self, action: str) -> None:
        self._action = action
        self._ended = threading.Event()
        self._outcome: Outcome | None = None

    def finish(self, outcome: Outcome) -> None:
        """Take the outcome."""
        self._outcome = outcome
        self._ended.set()

    def result(self, timeout_s: float) -> Outcome:
        """See ``ClientGoal.result``."""
        self._ended.wait(timeout_s)
        if self._outcome is None:
            raise BusError(
                f"The action {self._action} gave no result within {timeout_s:g} s.", "wait longer, or cancel it"
            )
        return self._outcome
