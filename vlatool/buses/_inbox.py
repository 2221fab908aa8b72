"""Messages of one subscription that wait for its handler: the newest alone, in a thread of their own."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from vlatool.buses._faults import Faults
from vlatool.buses._interface import Reception
from vlatool.messages import Message
from vlatool.messages.cdr import decode


class Inbox:
    """The newest messages of a topic, and the thread that decodes them and calls the handler.

    Args:
        topic: Its name.
        message: Its type.
        handler: What is called, one message at a time.
        depth: How many messages wait at most; the oldest gives way.
        unpack: What makes bytes of what the transport hands over.
        faults: Where malformed messages and the handler's errors are counted.
    """

    def __init__(
        self,
        topic: str,
        message: type[Message],
        handler: Callable[[Reception], None],
        depth: int,
        unpack: Callable[[Any], bytes],
        faults: Faults,
    ) -> None:
        self._topic, self._message, self._handler = topic, message, handler
        self._unpack, self._faults = unpack, faults
        self._waiting: deque[tuple[Any, float]] = deque(maxlen=max(1, depth))
        self._ready = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name=f"vlatool {topic}", daemon=True)
        self._thread.start()

    def put(self, raw: Any) -> None:
        """Take what has come, at once; called by the transport's thread."""
        with self._ready:
            self._waiting.append((raw, time.monotonic()))
            self._ready.notify()

    def close(self) -> None:
        """Call the handler no more; a call that runs is waited for, except from within it."""
        with self._ready:
            self._closed = True
            self._ready.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _work(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                raw, received_s = self._waiting.popleft()
            try:
                self._handler(Reception(decode(self._message, self._unpack(raw)), received_s))
            except Exception as error:  # a handler may raise anything; the bus goes on
                self._faults.add_raised(self._topic, error)
