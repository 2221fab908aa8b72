"""Bags that are written: by a thread of their own, so that whoever publishes never waits for a disk."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

from vlatool.errors import BusError, OutputError, require
from vlatool.messages import Message, cdr, ros1
from vlatool.messages.definition import text
from vlatool.messages.type_hash import rihs01

ROSBAG2_VERSION = 8
"""Version of the metadata; that of Iron, which later releases read, too."""
MAX_WAITING_BYTES = 256_000_000
"""Encoded messages that wait for the disk at most; what comes beyond is not recorded, and counted."""
ANOTHER_PATH = "name a path that does not exist; nothing is replaced"


class _Line(NamedTuple):
    topic: str
    kind: type[Message]
    time_ns: int
    content: bytes


class BagWriter:
    """A new bag.

    Args:
        path: ``NAME.bag`` is a file of ROS 1; ``NAME.db3`` the directory NAME with sqlite3 inside, ``NAME.mcap`` and
            ``NAME`` the directory NAME with mcap inside.

    Raises:
        MissingExtra: when rosbags is absent.
        OutputError: when the file or directory exists, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._first = path.suffix == ".bag"
        self.path = path if self._first or path.suffix not in (".mcap", ".db3") else path.with_suffix("")
        library: Any = require("rosbags.rosbag1" if self._first else "rosbags.rosbag2", "bags")
        if self.path.exists():
            raise OutputError(f"{self.path} exists already.", ANOTHER_PATH)
        self.lost = 0
        """Messages that were not recorded, because the disk was too slow."""
        self._changed = threading.Condition()
        self._waiting: deque[_Line] = deque()
        self._waiting_bytes = 0
        self._closed = False
        self._failure: Exception | None = None
        self._connections: dict[tuple[str, str], Any] = {}
        storage = None if self._first else self._storage(library, path)
        self._opened = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(library, storage), name="bag writer", daemon=True)
        self._thread.start()
        self._opened.wait()
        self._raise_failure()

    @staticmethod
    def _storage(library: Any, path: Path) -> Any:
        return library.StoragePlugin.SQLITE3 if path.suffix == ".db3" else library.StoragePlugin.MCAP

    def put(self, topic: str, message: Message, time_ns: int) -> None:
        """Let a message be written, as received at a time in nanoseconds since the epoch.

        Raises:
            BusError: when a value does not fit its field.
            OutputError: when an earlier message could not be written.
        """
        content = ros1.encode(message) if self._first else cdr.encode(message)
        with self._changed:
            self._raise_failure()
            if self._closed:
                raise BusError(f"The bag {self.path} is closed.", "publish before the bus is closed")
            if self._waiting_bytes + len(content) > MAX_WAITING_BYTES:
                self.lost += 1
                return
            self._waiting.append(_Line(topic, type(message), time_ns, content))
            self._waiting_bytes += len(content)
            self._changed.notify()

    def close(self) -> None:
        """Write what waits, then the index.

        Raises:
            OutputError: when something could not be written.
        """
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._raise_failure()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            text_of = getattr(self._failure, "strerror", None) or str(self._failure)
            reason = " ".join(text_of.split())[:160].rstrip(".") or type(self._failure).__name__
            raise OutputError(
                f"{self.path} cannot be written: {reason}.", "free space, or name a path that can be written"
            ) from self._failure

    def _run(self, library: Any, storage: Any) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            options = {} if storage is None else {"version": ROSBAG2_VERSION, "storage_plugin": storage}
            writer = library.Writer(self.path, **options)
            writer.open()
            self._opened.set()
            try:
                while (line := self._next()) is not None:
                    writer.write(self._connection(writer, line), line.time_ns, line.content)
            except Exception:
                writer.abort()
                raise
            writer.close()
        except Exception as error:  # OSError, and the errors of rosbags, sqlite3 and others
            self._failure = error
        finally:
            self._opened.set()

    def _next(self) -> _Line | None:
        """Return what is to be written next; None when there is nothing more."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed)
            if not self._waiting:
                return None
            line = self._waiting.popleft()
            self._waiting_bytes -= len(line.content)
            return line

    def _connection(self, writer: Any, line: _Line) -> Any:
        """Return rosbags' connection of a topic, which is added with its first message."""
        key = line.topic, line.kind.TYPE
        if key not in self._connections:
            described = (
                {"msgdef": ros1.definition(line.kind), "md5sum": ros1.md5sum(line.kind)}
                if self._first
                else {"msgdef": text(line.kind), "rihs01": rihs01(line.kind)}
            )
            self._connections[key] = writer.add_connection(line.topic, line.kind.TYPE, **described)
        return self._connections[key]
