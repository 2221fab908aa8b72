"""What waits for a controller between two steps: the newest messages of each input, and calls of services."""

from __future__ import annotations

import threading
from collections import deque

from vlatool.controllers import Reading, Request
from vlatool.errors import BusError
from vlatool.messages import Message

MAX_CALLS = 64
"""Calls of services that wait at a time; more than that are refused at once."""


class Inbox:
    """The newest messages of one input; a bus's thread fills it, a step empties it.

    Args:
        depth: How many messages wait; the oldest gives way.
    """

    def __init__(self, depth: int) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Reading] = deque(maxlen=depth)
        self._count = 0
        self.overwritten = 0
        """Messages that gave way before a step saw them."""
        self.newest: Reading | None = None
        """The newest message that ``take`` has returned; None before the first one."""

    def put(self, message: Message, received_s: float) -> None:
        """Add a message, which came at a time of the controller's clock, in seconds."""
        with self._lock:
            self.overwritten += len(self._waiting) == self._waiting.maxlen
            self._waiting.append(Reading(message, received_s, self._count))
            self._count += 1

    def take(self) -> tuple[Reading, ...]:
        """Return what came since the last call, the oldest first."""
        with self._lock:
            found = tuple(self._waiting)
            self._waiting.clear()
        if found:
            self.newest = found[-1]
        return found


class _Call:
    """One call of a service, and what it waits for."""

    def __init__(self, request: Request) -> None:
        self.request = request
        self.done = threading.Event()
        self.response: Message | None = None


class Calls:
    """Calls of services: a thread of the bus waits in ``ask`` until a step has answered."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._new: list[_Call] = []
        self._open: dict[int, _Call] = {}
        self._count = 0
        self._ended = False

    def ask(self, service: str, message: Message, timeout_s: float) -> Message:
        """Return the answer to a call.

        Raises:
            BusError: when no step answers in time, too many calls wait, or the controller has ended.
        """
        call = self.add(service, message)
        answered = call.done.wait(timeout_s)
        with self._lock:
            self._open.pop(call.request.number, None)
            self._new = [each for each in self._new if each is not call]
        if call.response is not None:
            return call.response
        why = f"no step answered within {timeout_s:g} s" if not answered else "the controller has ended"
        raise BusError(f"The service '{service}' gave no answer: {why}.", "call it again while the controller runs")

    def add(self, service: str, message: Message) -> _Call:
        """Let a call wait for the next step; raises BusError when too many wait, or the controller has ended."""
        with self._lock:
            if self._ended or len(self._open) >= MAX_CALLS:
                why = "the controller has ended" if self._ended else f"{MAX_CALLS} calls already wait"
                raise BusError(f"The service '{service}' takes no call: {why}.", "call it later")
            call = _Call(Request(service, message, self._count))
            self._count += 1
            self._new.append(call)
            self._open[call.request.number] = call
        return call

    def take(self) -> tuple[Request, ...]:
        """Return the calls since the last call of this, in order."""
        with self._lock:
            found, self._new = self._new, []
        return tuple(call.request for call in found)

    def answer(self, number: int, response: Message) -> None:
        """Answer a call; one that nobody waits for any longer is passed over."""
        with self._lock:
            call = self._open.pop(number, None)
        if call is not None:
            call.response = response
            call.done.set()

    def end(self) -> None:
        """Let every caller go, and refuse new calls."""
        with self._lock:
            self._ended = True
            calls, self._open, self._new = list(self._open.values()), {}, []
        for call in calls:
            call.done.set()
