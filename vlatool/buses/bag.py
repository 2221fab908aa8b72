"""A recorded bag as a bus: ``bag:RECORDING``, ``bag:RECORDING:NEW`` or ``bag::NEW``; what is published goes to NEW."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from vlatool.buses._bag_reader import BagReader, Recorded
from vlatool.buses._bag_writer import BagWriter
from vlatool.buses._faults import Faults
from vlatool.buses._interface import Fault, M, QoS, Reception, TopicInfo
from vlatool.buses._names import check_node, resolve
from vlatool.errors import BusError, UsageError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time

SECOND = 1_000_000_000


class Bag:
    """A node that hears a recording, and whose messages are recorded.

    The recording plays once, in real time, from the first call of ``wait_for_peers`` or ``stamp`` on, for the topics
    that are subscribed to by then. Or it is played by ``play``, as fast as the handlers are.

    Args:
        address: RECORDING, RECORDING:NEW or :NEW: a bag to read, and one to write, which must not exist.
        node: Name of this node.

    Raises:
        UsageError: for an address that names neither.
        MissingExtra: when rosbags is absent.
        BusError: when the recording is absent or cannot be read.
        OutputError: when NEW exists or cannot be written.
    """

    def __init__(self, address: str, node: str) -> None:
        self.node = check_node(node)
        recording, _, new = address.partition(":")
        if not (recording or new) or ":" in new:
            raise UsageError(
                f"'bag:{address}' names no bag; a recording, a new bag, or both are named.",
                "write bag:RECORDING, bag:RECORDING:NEW, or bag::NEW to record alone",
            )
        self._reader = BagReader(Path(recording)) if recording else None
        try:
            self._writer = BagWriter(Path(new)) if new else None
        except Exception:
            if self._reader is not None:
                self._reader.close()
            raise
        self._handlers: dict[str, list[Callable[[Reception], None]]] = {}
        self._published: dict[str, type[Message]] = {}
        self._lock = threading.Lock()
        self._closed, self.ended = threading.Event(), threading.Event()
        """``ended`` is set when the recording is over."""
        self._thread: threading.Thread | None = None
        self._began_s: float | None = None
        self._time_ns: int | None = None
        self._failure: Exception | None = None
        self._faults = Faults()

    @property
    def duration_s(self) -> float:
        """Length of the recording, in seconds; 0 without one."""
        return (self._reader.end_ns - self._reader.start_ns) / SECOND if self._reader else 0.0

    @property
    def new_path(self) -> Path | None:
        """File or directory of the new bag; None without one."""
        return self._writer.path if self._writer else None

    def subscribe(self, topic: str, message: type[M], handler: Callable[[Reception], None], qos: QoS) -> None:
        """See ``Bus.subscribe``; a topic that the recording lacks stays silent, and ``qos`` is of no matter."""
        name = self._agreed(topic, message)
        with self._lock:
            self._handlers.setdefault(name, []).append(handler)

    def publisher(self, topic: str, message: type[M], qos: QoS) -> Callable[[M], None]:
        """See ``Bus.publisher``; without a new bag, messages are checked and go nowhere."""
        name = self._agreed(topic, message)
        self._published[name] = message

        def send(content: M) -> None:
            if self._closed.is_set():
                raise BusError(f"The node {self.node} has left the bus.", "open the bus again")
            if type(content) is not message:
                raise BusError(f"The topic {name} carries {message.TYPE}, not a {type(content).__name__}.", "send one")
            if self._writer is not None:
                now = self.stamp()
                self._writer.put(name, content, now.sec * SECOND + now.nanosec)

        return send

    def serve(self, service: str, request: type[Message], response: type[M], handler: Callable[[Message], M]) -> None:
        """Accept a service that nobody will call: a bag holds topics alone."""
        resolve(service, self.node)

    def call(self, service: str, request: Message, response: type[M], timeout_s: float) -> M:
        """Raise BusError: a bag answers no service."""
        raise BusError(f"Nobody serves {resolve(service, self.node)}: a bag holds topics alone.", "use another bus")

    def topics(self) -> list[TopicInfo]:
        """Return the topics of the recording, which nobody publishes now, and those of this node."""
        types = dict(self._reader.types) if self._reader else {}
        types.update({name: (kind.TYPE,) for name, kind in self._published.items() if name not in types})
        own = (self.node,)
        return [
            TopicInfo(name, types[name], own if name in self._published else (), own if name in self._handlers else ())
            for name in sorted(types)
        ]

    def faults(self) -> list[Fault]:
        """See ``Bus.faults``; a damaged recording is not among them: ``close`` raises it."""
        return self._faults.listing()

    def stamp(self) -> Time:
        """Return the recorded time of this moment; without a recording, that of the system's clock."""
        if self._reader is None:
            return Time(*divmod(time.time_ns(), SECOND))
        if self._time_ns is None:
            self._start()
        with self._lock:
            if self._time_ns is not None:
                return Time(*divmod(self._time_ns, SECOND))
            elapsed = 0.0 if self._began_s is None else time.monotonic() - self._began_s
        return Time(*divmod(self._reader.start_ns + round(elapsed * SECOND), SECOND))

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        """Let the recording play, and return the topics that it lacks, at once."""
        recorded = self._reader.types if self._reader else {}
        missing = tuple(topic for topic in topics if resolve(topic, self.node) not in recorded)
        if not missing:
            self._start()
        return missing

    def messages(self, topics: Collection[str] = ()) -> Iterator[Recorded]:
        """Yield the recorded messages of some topics, or of all whose type is known, in order.

        Raises:
            BusError: when a topic has a type that vlatool lacks, or a message is malformed.
        """
        if self._reader is None:
            raise BusError("This bus was opened without a recording.", "open bag:RECORDING")
        yield from self._reader.messages(topics or self._reader.readable_topics())

    def play(self, until_s: float = float("inf")) -> int:
        """Hand the recorded messages to the handlers, in order and in this thread; return how many there were.

        ``Reception.received_s`` is the recorded time since the start of the recording; messages that a handler
        publishes have the recorded time of the message that it got.

        Args:
            until_s: Where to end, in seconds since the start of the recording.
        """
        count = 0
        for topic, time_ns, message in self._heard():
            seconds = (time_ns - self._start_ns) / SECOND
            if seconds > until_s:
                break
            self._time_ns = time_ns
            for handler in tuple(self._handlers[topic]):
                handler(Reception(message, seconds))
            count += 1
        self.ended.set()
        return count

    def close(self) -> None:
        """See ``Bus.close``; the new bag is complete.

        Raises:
            OutputError: when something could not be written.
            BusError: when messages were lost, or the recording turned out to be damaged.
        """
        if self._closed.is_set():
            return
        self._closed.set()
        with self._lock:
            thread = self._thread
        if thread is not None and threading.current_thread() is not thread:
            thread.join(5.0)
        if self._reader is not None:
            self._reader.close()
        if self._writer is not None:
            self._writer.close()
            if self._writer.lost:
                raise BusError(
                    f"{self._writer.lost} messages are not in {self._writer.path}: the disk was too slow.",
                    "record fewer topics, or on another disk",
                )
        if self._failure is not None:
            raise self._failure

    @property
    def _start_ns(self) -> int:
        return self._reader.start_ns if self._reader else 0

    def _agreed(self, topic: str, message: type[Message]) -> str:
        """Return the full name of a topic; raises BusError when it carries another type."""
        name = resolve(topic, self.node)
        types = self._reader.types.get(name, ()) if self._reader else ()
        own = self._published.get(name)
        if (types and types != (message.TYPE,)) or own not in (None, message):
            carried = ", ".join(types) or (own.TYPE if own else "")
            raise BusError(f"The topic {name} carries {carried}, not {message.TYPE}.", "map it to another name")
        if types and self._reader:
            self._reader.kind(name)
        return name

    def _heard(self) -> Iterator[Recorded]:
        """Yield the recorded messages for which there is a handler."""
        if self._reader is not None:
            with self._lock:
                wanted = [topic for topic in self._handlers if topic in self._reader.types]
            yield from self._reader.messages(wanted)

    def _start(self) -> None:
        """Let the recording play in real time, unless it does or did."""
        with self._lock:
            if self._began_s is not None or self._reader is None or self._closed.is_set():
                return
            self._began_s = time.monotonic()
            self._thread = threading.Thread(target=self._play_in_time, name="bag", daemon=True)
            self._thread.start()

    def _play_in_time(self) -> None:
        began = self._began_s or 0.0
        try:
            for topic, time_ns, message in self._heard():
                wait_s = began + (time_ns - self._start_ns) / SECOND - time.monotonic()
                if self._closed.wait(max(0.0, wait_s)) if wait_s > 0 else self._closed.is_set():
                    return
                for handler in tuple(self._handlers[topic]):
                    try:
                        handler(Reception(message, time.monotonic()))
                    except Exception as error:
                        self._faults.add_raised(topic, error)
        except BusError as error:  # the recording is damaged
            self._failure = error
        finally:
            self.ended.set()
