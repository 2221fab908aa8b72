"""Recorded bags, message by message: mcap and sqlite3 of ROS 2, ``.bag`` of ROS 1."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from vlatool.errors import BusError, InputError, UsageError, require
from vlatool.files.bag_files import SUFFIXES, bag_errors, bag_repair, refuse_unfinished
from vlatool.messages import Message, cdr, find_type, ros1
from vlatool.messages.type_hash import rihs01


class Recorded(NamedTuple):
    """A message of a bag.

    Args:
        topic: Topic.
        time_ns: When it was recorded, in nanoseconds since the epoch of the recorder's clock.
        message: The message; its arrays are read-only views.
    """

    topic: str
    time_ns: int
    message: Message


class BagReader:
    """An open bag.

    Args:
        path: A ``.bag``, ``.mcap`` or ``.db3`` file, or the directory of a bag of ROS 2.

    Raises:
        MissingExtra: when rosbags is absent.
        BusError: when the bag is absent or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        first = path.suffix == ".bag"
        library: Any = require("rosbags.rosbag1" if first else "rosbags.rosbag2", "bags")
        if not path.exists():
            raise BusError(
                f"There is no bag {path}.", "name a .bag, .mcap or .db3 file, or the directory of a ROS 2 bag"
            )
        refuse_unfinished(path, BusError)
        if not path.is_dir() and path.suffix not in SUFFIXES:
            raise BusError(f"{path} is not a bag: its name ends in none of {', '.join(SUFFIXES)}.", "name a bag")
        with bag_errors(path, BusError):
            self._reader = library.Reader(path)
            self._reader.open()
        self._decode: Callable[[Any, Any], Message] = ros1.decode if first else cdr.decode
        self._sum = ros1.md5sum if first else rihs01
        self.types: dict[str, tuple[str, ...]] = {}
        """Topic -> ROS 2 names of its types."""
        for each in self._reader.connections:
            self.types[each.topic] = tuple(sorted({*self.types.get(each.topic, ()), each.msgtype}))
        empty = self._reader.message_count == 0
        self.start_ns: int = 0 if empty else self._reader.start_time
        self.end_ns: int = 0 if empty else self._reader.end_time

    def kind(self, topic: str) -> type[Message]:
        """Return the class of a topic's messages.

        Raises:
            BusError: when the topic has several types, one that vlatool lacks, or another definition of it.
        """
        names = self.types[topic]
        if len(names) != 1:
            raise BusError(f"The topic {topic} of {self.path} has the types {', '.join(names)}.", "record one of them")
        try:
            kind = find_type(names[0])
        except UsageError as error:
            raise BusError(
                f"The topic {topic} of {self.path} carries {names[0]}, which vlatool lacks.", error.fix
            ) from None
        for each in self._reader.connections:
            if each.topic == topic and each.digest not in ("", "*", self._sum(kind)):
                raise BusError(
                    f"{names[0]} is defined otherwise in {self.path} ({topic}: {each.digest}) than here "
                    f"({self._sum(kind)}).", "record with the common definition of that type",
                )  # fmt: skip
        return kind

    def readable_topics(self) -> tuple[str, ...]:
        """Return the topics whose messages can be read, sorted by name."""
        found = []
        for topic in sorted(self.types):
            try:
                self.kind(topic)
            except InputError:
                continue
            found.append(topic)
        return tuple(found)

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """Yield the messages of some topics in the order in which they were recorded.

        Raises:
            BusError: see ``kind``; also for a message that is malformed.
        """
        kinds = {topic: self.kind(topic) for topic in topics}
        chosen = [each for each in self._reader.connections if each.topic in kinds]
        if not chosen:
            return
        with bag_errors(self.path, BusError):
            for connection, time_ns, content in self._reader.messages(connections=chosen):
                try:
                    message = self._decode(kinds[connection.topic], content)
                except BusError as error:
                    where = f"A message of {connection.topic} in {self.path}, {(time_ns - self.start_ns) / 1e9:.3f} s"
                    raise BusError(
                        f"{where} after its start, is malformed: {error.message}", bag_repair(self.path)
                    ) from error
                yield Recorded(connection.topic, time_ns, message)

    def close(self) -> None:
        """Close the bag."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
