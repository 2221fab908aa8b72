"""The log of a run in a file of a bounded size: what runs, each step, and the messages that steps were made from.

The file is that of recorded runs (``vlatool.runtime.telemetry.run_file``): checksummed frames, readable up to the last
one that was written whole. Its frames: a header with what runs, one call for each message that a controller read, one
tick for each step, and an end with why the log is not whole, if it is not.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vlatool.buses import Bus, QoS
from vlatool.errors import BusError, DataError, UsageError
from vlatool.messages import Message, find_type
from vlatool.messages.cdr import decode, encode
from vlatool.messages.std_msgs import String
from vlatool.nodes.content import digest
from vlatool.nodes.step_record import CONTROLLER, STEPS, ControllerRecord, StepRecord, topic_of
from vlatool.nodes.stepper import StepReport
from vlatool.runtime.telemetry.run_file import Frame, FrameKind, RunWriter, read_run

MAX_BYTES = 2_000_000_000
"""Default size of a log, at which it ends: half an hour of a camera of 640 x 480 at 1 Hz, or days without one."""
WAITING = 256
"""Reports that wait to be written."""


class Background:
    """Passes reports to observers in a thread of its own, so that a step waits neither for a disk nor for a bus.

    Args:
        observers: Called with each report, in order. One that raises gets no further ones; ``failure`` says why.
    """

    def __init__(self, *observers: Callable[[StepReport], None]) -> None:
        self._observers = list(observers)
        self._waiting: queue.Queue[StepReport | None] = queue.Queue(WAITING)
        self.lost = 0
        """Reports that found no place to wait."""
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="vlatool-observers", daemon=True)
        self._thread.start()

    def observe(self, *observers: Callable[[StepReport], None]) -> None:
        """Add observers, before the first report."""
        self._observers.extend(observers)

    def __call__(self, report: StepReport) -> None:
        """Take a report; never waits."""
        try:
            self._waiting.put_nowait(report)
        except queue.Full:
            self.lost += 1

    def _work(self) -> None:
        while (report := self._waiting.get()) is not None:
            for observer in list(self._observers):
                try:
                    observer(report)
                except Exception as error:
                    self.failure = self.failure or error
                    self._observers.remove(observer)

    def close(self) -> None:
        """Wait until all reports are passed on, and end the thread."""
        self._waiting.put(None)
        self._thread.join()


class StepPublisher:
    """Publishes what runs, once and latched, and the record of each step.

    Args:
        bus: The bus.
        record: What runs.
    """

    def __init__(self, bus: Bus, record: ControllerRecord) -> None:
        self._send = bus.publisher(topic_of(record.node, STEPS), String, QoS(reliable=True, depth=100))
        about = bus.publisher(topic_of(record.node, CONTROLLER), String, QoS(reliable=True, latched=True))
        about(String(record.to_json()))

    def __call__(self, report: StepReport) -> None:
        """Publish the record of a step."""
        self._send(String(StepRecord.of(report).to_json()))


class RunLog:
    """Writes a log.

    Args:
        path: New file.
        record: What runs.
        max_bytes: Size at which the log ends; the run goes on.

    Raises:
        DataError: when the file exists or cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], record: ControllerRecord, max_bytes: int = MAX_BYTES) -> None:
        self._writer = RunWriter(path)
        self._most = max_bytes
        self._broken = False
        self.full = False
        """Whether the log ended before the run."""
        self._append(Frame(FrameKind.HEADER, {"controller": record.to_json()}, {}))

    def _append(self, frame: Frame) -> None:
        self._broken = True  # behind a frame that was written in part, none can be read
        self.full = self.full or not self._writer.append(frame, self._most)
        self._broken = False

    def __call__(self, report: StepReport) -> None:
        """Write a step and the messages that it was made from."""
        if self.full:
            return
        for name, readings in report.snapshot.readings.items():
            for reading in readings:
                content = np.frombuffer(encode(reading.message), np.uint8)
                about = {"input": name, "type": reading.message.TYPE, "digest": digest(reading.message)}
                self._append(Frame(FrameKind.CALL, about, {"cdr": content}))
        self._append(Frame(FrameKind.TICK, {"record": StepRecord.of(report).to_json()}, {}))

    def close(self, lost: int = 0) -> None:
        """Write the end, unless a frame could not be written, and close the file.

        Args:
            lost: Reports that never reached this log.

        Raises:
            OSError: when the end cannot be written.
        """
        note = "the log was full" if self.full else f"{lost} steps were not written" if lost else ""
        try:
            if not self._broken:
                self._writer.append(Frame(FrameKind.END, {"note": note}, {}))
        finally:
            self._writer.close()


class Received(NamedTuple):
    """A message of a recording.

    Args:
        channel: Name of the input (of a log), or topic (of a bag).
        message: The message.
        digest: What tells it from others.
    """

    channel: str
    message: Message
    digest: str


class LogEnd(NamedTuple):
    """The end of a log, and why it is not whole; an empty note where it is."""

    note: str


Item = ControllerRecord | StepRecord | Received | LogEnd
CUT = "the log has no end: its process was killed, or the file was cut"


def read_log(path: Path) -> Iterator[Item]:
    """Return what a log holds, in order; last what its end says, or that it has none.

    Raises:
        DataError: when it is damaged, or the log of something else than a controller.
    """
    end = LogEnd(CUT)
    for frame in read_run(path):
        try:
            if frame.kind is FrameKind.HEADER:
                yield ControllerRecord.from_json(frame.values["controller"])
            elif frame.kind is FrameKind.TICK:
                yield StepRecord.from_json(frame.values["record"])
            elif frame.kind is FrameKind.CALL:
                message = decode(find_type(frame.values["type"]), frame.arrays["cdr"].tobytes())
                yield Received(str(frame.values["input"]), message, str(frame.values["digest"]))
            else:
                end = LogEnd(str(frame.values["note"]))
        except (KeyError, AttributeError, BusError, UsageError) as error:
            raise DataError(f"{path} is not the log of a controller: {error}.",
                            "name a file of vlatool run --record, or a bag") from None  # fmt: skip
    yield end


def is_log(path: Any) -> bool:
    """Return whether a file begins as a recorded run does."""
    try:
        with Path(path).open("rb") as file:
            return file.read(8) == b"VLARUN1\n"
    except OSError:
        return False
