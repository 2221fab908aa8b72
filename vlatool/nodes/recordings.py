"""Recordings of runs as a replay reads them: the log of a run, or a bag with a node's records beside the messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from vlatool.buses.bag import Bag
from vlatool.errors import DataError
from vlatool.files.bag_files import SUFFIXES, UNFINISHED_SUFFIX
from vlatool.messages.std_msgs import String
from vlatool.nodes.content import digest
from vlatool.nodes.run_log import Item, Received, is_log, read_log
from vlatool.nodes.step_record import CONTROLLER, STEPS, ControllerRecord, StepRecord, topic_of

NODE = "vlatool_replay"


@dataclass(frozen=True)
class Recording:
    """A recorded run.

    Args:
        path: The file, or the directory of a bag.
        about: What ran.
        topics: Input, output or service -> topic, where messages are listed by topic; None where by input.
    """

    path: Path
    about: ControllerRecord
    topics: Mapping[str, str] | None

    def items(self) -> Iterator[Item]:
        """Yield what is in it, in order.

        Raises:
            DataError, BusError: when it is damaged.
        """
        if self.topics is None:
            yield from read_log(self.path)
            return
        steps = topic_of(self.about.node, STEPS)
        bag = Bag(str(self.path), NODE)
        try:
            present = {info.topic for info in bag.topics()}
            for topic, _, message in bag.messages([steps, *({*self.topics.values()} & present)]):
                if topic == steps:
                    yield StepRecord.from_json(_text(message))
                else:
                    yield Received(topic, message, digest(message))
        finally:
            bag.close()


def open_recording(path: Path, controller: str, node: str = "") -> Recording:
    """Return a recorded run of a controller.

    Args:
        controller: Name of the controller.
        node: Name of its node, where a bag has several runs.

    Raises:
        DataError: when it cannot be read, or is of another controller or of none.
        BusError, MissingExtra: as the bus ``bag`` does.
    """
    if not path.exists():
        bag = path.with_suffix("")
        fix = f"name the directory of the bag: {bag}" if path.suffix in SUFFIXES and bag.is_dir() else "check the path"
        raise DataError(f"There is no recording at {path}.", fix)
    if not is_log(path):  # by its first bytes: a log may be called as a bag is
        if path.is_dir() or path.suffix in (*SUFFIXES, UNFINISHED_SUFFIX):
            return _of_bag(path, controller, node)
        raise DataError(f"{path} is not a recorded run.", "name a file of vlatool run --record, or a bag")
    about = next((item for item in read_log(path) if isinstance(item, ControllerRecord)), None)
    if about is None or not _is(about, controller):
        raise _other(path, [] if about is None else [about], controller)
    return Recording(path, about, None)


def _of_bag(path: Path, controller: str, node: str) -> Recording:
    found = _records(path)
    fitting = [about for about in found if _is(about, controller) and node.strip("/") in ("", about.node)]
    if not fitting and (others := [about.node for about in found if _is(about, controller)]):
        raise DataError(f"{path} has no run of the node '{node}'; nodes of '{controller}': {', '.join(others)}.",
                        f"name one of them: --node {others[0]}")  # fmt: skip
    if not fitting:
        raise _other(path, found, controller)
    if len(fitting) > 1:
        names = ", ".join(about.node for about in fitting)
        raise DataError(
            f"{path} has several runs of '{fitting[0].controller}': {names}.",
            f"name one of them: --node {fitting[0].node}",
        )
    steps, present = topic_of(fitting[0].node, STEPS), _topics(path)
    if steps not in present:
        raise DataError(f"{path} lacks the topic {steps}, which says what each step read.", "record it, too")
    return Recording(path, fitting[0], fitting[0].topics)


def _topics(path: Path) -> list[str]:
    bag = Bag(str(path), NODE)
    try:
        return [info.topic for info in bag.topics()]
    finally:
        bag.close()


def _records(path: Path) -> list[ControllerRecord]:
    """Return what ran, by the topics /NODE/controller of a bag; the first of each node, whose steps come first, too."""
    bag = Bag(str(path), NODE)
    try:
        topics = [info.topic for info in bag.topics()
                  if info.topic.endswith(f"/{CONTROLLER}") and info.types == (String.TYPE,)]  # fmt: skip
        texts = [(topic, _text(message)) for topic, _, message in bag.messages(topics)] if topics else []
    finally:
        bag.close()
    return list({topic: ControllerRecord.from_json(text) for topic, text in reversed(texts)}.values())[::-1]


def _text(message: object) -> str:
    return message.data if isinstance(message, String) else ""


def _is(about: ControllerRecord, controller: str) -> bool:
    return about.controller.replace("-", "_") == controller.replace("-", "_")


def _other(path: Path, found: list[ControllerRecord], controller: str) -> DataError:
    if not found:
        return DataError(
            f"{path} does not say which controller ran.",
            f"record the topics /NODE/{CONTROLLER} and /NODE/{STEPS}, too, from before the start",
        )
    names = ", ".join(f"'{about.controller}' ({about.node})" for about in found)
    return DataError(f"{path} was recorded with {names}, not with '{controller}'.",
                     f"vlatool replay {path} {found[0].controller}")  # fmt: skip
