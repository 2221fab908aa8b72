"""What is on a bus: types, rates, ages and publishers of its topics, and what is wrong with them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from vlatool.buses import Bus, QoS, Reception, TopicInfo
from vlatool.errors import BusError, UsageError
from vlatool.files.printable import truncate
from vlatool.messages import find_type
from vlatool.nodes.fault_watch import fault_text
from vlatool.nodes.runner import COMMANDS

MAX_NAME = 80
"""Characters of a name that a line shows: other nodes choose theirs."""


@dataclass(frozen=True)
class TopicReport:
    """One topic.

    Args:
        topic: Name.
        types: Types that its ends state.
        publishers: Nodes that publish it.
        subscribers: Nodes that subscribe to it, without this one.
        messages: Messages that came while it was watched.
        hz: Their rate; None for fewer than two.
        age_ms: Age of the newest by its stamp, in milliseconds; None without a stamp.
        problems: What is wrong with it.
    """

    topic: str
    types: tuple[str, ...]
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    messages: int = 0
    hz: float | None = None
    age_ms: float | None = None
    problems: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        return asdict(self)


class _Watch:
    """Counts the messages of one topic."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self._lock = bus, threading.Lock()
        self.count, self.first_s, self.last_s = 0, 0.0, 0.0
        self.age_ms: float | None = None

    def __call__(self, got: Reception) -> None:
        stamp = getattr(getattr(got.message, "header", None), "stamp", None)
        age = None
        if stamp is not None and (stamp.sec or stamp.nanosec):
            age = (self._bus.stamp().seconds - stamp.seconds) * 1e3
        with self._lock:
            self.first_s = got.received_s if not self.count else self.first_s
            self.count, self.last_s, self.age_ms = self.count + 1, got.received_s, age

    def hz(self) -> float | None:
        seconds = self.last_s - self.first_s
        return (self.count - 1) / seconds if self.count > 1 and seconds > 0 else None


def survey(bus: Bus, node: str, seconds: float) -> list[TopicReport]:
    """Watch a bus for some time and return its topics, sorted by name.

    Args:
        bus: The bus.
        node: Name of the node that this bus was opened for; it is left out of the lists.
        seconds: How long; topics that appear meanwhile are watched from then on.
    """
    watches: dict[str, _Watch] = {}
    refused: dict[str, str] = {}
    recorded = {info.topic for info in bus.topics() if not info.publishers and not info.subscribers}
    end = time.monotonic() + seconds
    while True:
        for info in bus.topics():
            if info.topic not in watches and info.topic not in refused and info.types:
                _watch(bus, info, watches, refused)
        bus.wait_for_peers((), 0.0)  # a recording plays the topics that are watched by then
        left = end - time.monotonic()
        if left <= 0:
            break
        time.sleep(min(0.2, left))
    faults = {fault.topic: fault_text(fault) for fault in bus.faults()}
    return [_report(info, watches.get(info.topic), (refused.get(info.topic), faults.get(info.topic)), node)
            for info in bus.topics()
            if info.topic in recorded or {*info.publishers, *info.subscribers} - {node}]  # fmt: skip


def _watch(bus: Bus, info: TopicInfo, watches: dict[str, _Watch], refused: dict[str, str]) -> None:
    """Subscribe to a topic, or note why that is impossible."""
    watch = _Watch(bus)
    try:
        kind = find_type(info.types[0])
    except UsageError:
        refused[info.topic] = f"vlatool has no message {truncate(info.types[0], MAX_NAME)}: it is listed, not read"
        return
    try:
        bus.subscribe(info.topic, kind, watch, QoS(depth=10))
    except (BusError, UsageError) as error:
        refused[info.topic] = error.message
    else:
        watches[info.topic] = watch


def _report(info: TopicInfo, watch: _Watch | None, seen: Sequence[str | None], node: str) -> TopicReport:
    publishers = tuple(name for name in info.publishers if name != node)
    subscribers = tuple(name for name in info.subscribers if name != node)
    problems = [problem for problem in seen if problem]
    if len(info.types) > 1:
        problems.append(f"{len(info.types)} types on one topic: {', '.join(info.types)}")
    if len(publishers) > 1 and set(info.types) & {*COMMANDS}:
        problems.append(f"{len(publishers)} publishers command one robot: {', '.join(publishers)}")
    if watch is None:
        return TopicReport(info.topic, info.types, publishers, subscribers, problems=tuple(problems))
    if watch.age_ms is not None and watch.age_ms < -50:
        problems.append(f"its stamps are {-watch.age_ms / 1e3:.3g} s in the future")
    return TopicReport(info.topic, info.types, publishers, subscribers, watch.count, watch.hz(), watch.age_ms,
                       tuple(problems))  # fmt: skip


def lines(reports: Sequence[TopicReport]) -> Iterator[str]:
    """Return what a person reads."""
    if not reports:
        yield "no topic"
        return
    width = min(max(len(report.topic) for report in reports), MAX_NAME)
    for report in reports:
        rate = "-" if report.hz is None else f"{report.hz:.1f} Hz"
        age = "-" if report.age_ms is None else f"{report.age_ms:.1f} ms"
        ends = f"{_names(report.publishers) or '-'} -> {_names(report.subscribers) or '-'}"
        topic = truncate(report.topic, MAX_NAME)
        yield f"{topic:{width}}  {_names(report.types) or '?':32}  {rate:>9}  {age:>10}  {ends}"
        for problem in report.problems:
            yield f"  ! {problem}"


def _names(names: Sequence[str]) -> str:
    """Return names with commas between them, long ones in part."""
    return ", ".join(truncate(name, MAX_NAME) for name in names)
