"""Readers and writers of Cyclone DDS that pass finished bytes, with a thread for each reader.

The serializer of cyclonedds' Python package takes milliseconds for an image; its C functions take and return bytes.
Readers wait in threads rather than in listeners: a listener holds locks of Cyclone DDS while it waits for Python's,
which a writer in another thread may hold.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from vlatool.buses._interface import QoS
from vlatool.errors import BusError, require

FOREVER_NS = 2**63 - 1
BATCH = 256
"""Changes of the discovery that are taken at once."""
ATTEMPTS = 5
"""How often a change that cyclonedds fails to build is looked at again."""
ANY_STATE = 0x7F
"""Mask of all sample, view and instance states."""
ALIGNMENT = 4
"""Cyclone DDS sends whole words of four bytes."""
TIMEOUT = -10
"""What a write returns that would have to wait (``DDS_RETCODE_TIMEOUT``)."""
ACKNOWLEDGED_NS = 200_000_000
"""How long closing waits for readers to acknowledge what was sent reliably."""


class Endpoints:
    """Readers and writers in a participant, until it is closed.

    Args:
        domain: Number of the domain.

    Raises:
        BusError: when Cyclone DDS cannot open a participant.
    """

    def __init__(self, domain: int) -> None:
        self._core, self._clayer = require("cyclonedds.core", "dds"), require("cyclonedds._clayer", "dds")
        self._topics, self._sub = require("cyclonedds.topic", "dds"), require("cyclonedds.sub", "dds")
        self._pub, self._builtin = require("cyclonedds.pub", "dds"), require("cyclonedds.builtin", "dds")
        qos = self._core.Qos(self._core.Policy.Userdata(b"enclave=/;"))
        try:
            self.participant: Any = require("cyclonedds.domain", "dds").DomainParticipant(domain, qos=qos)
        except self._core.DDSException as error:
            raise BusError(
                f"DDS cannot take part in domain {domain}: {error}",
                "check the interface, and whether many programs use this domain on this machine (at most 64 here)",
            ) from error
        self._threads: list[_ReaderThread] = []
        self._reliable: list[Any] = []

    def writer(self, topic: str, described: Any, qos: QoS, type_hash: str) -> _Writer:
        """Return what writes finished CDR bytes to a topic; it never waits."""
        writer = self._pub.DataWriter(
            self.participant, self._topic(topic, described), qos=self._policies(qos, type_hash, writes=True)
        )
        if qos.reliable:
            self._reliable.append(writer)
        return _Writer(self._clayer, writer, topic)

    def reader(
        self, topic: str, described: Any, qos: QoS, type_hash: str, handle: Callable[[bytes, float], None]
    ) -> Any:
        """Return a reader; ``handle`` is called with the CDR bytes of each message and when they came, in a thread."""
        reader = self._sub.DataReader(
            self.participant, self._topic(topic, described), qos=self._policies(qos, type_hash, writes=False)
        )
        take = self._clayer.ddspy_take

        def pass_on() -> bool:
            taken = take(reader._ref, ANY_STATE, 1)
            if isinstance(taken, int) or not taken:
                return False
            data, info = taken[0]
            if info.valid_data:
                handle(data, time.monotonic())
            return True

        self._start(reader, pass_on, topic)
        return reader

    def watch(self, builtin_topic: Any, handle: Callable[[Any], None]) -> None:
        """Call ``handle`` with each change that DDS's discovery reports, in a thread."""
        reader = self._builtin.BuiltinDataReader(self.participant, builtin_topic)

        def pass_on() -> bool:
            taken = self._take_or_look_again(reader, builtin_topic)
            for sample in taken:
                handle(sample)
            return bool(taken)

        self._start(reader, pass_on, "discovery")

    def _take_or_look_again(self, reader: Any, builtin_topic: Any) -> Any:
        """Return the newest changes; all that there is where cyclonedds fails to build one, and drops those beside it.

        It raises a plain Exception then, "Callfunc endpoint constructor errored.": seen once, among seven nodes of one
        process that came at the same time.
        """
        for _ in range(ATTEMPTS):
            try:
                return reader.take(BATCH)
            except self._core.DDSException:
                raise
            except Exception:
                reader = self._builtin.BuiltinDataReader(self.participant, builtin_topic)
        return reader.take(BATCH)

    def close(self) -> None:
        """End the threads, wait until readers have what was sent reliably, and leave the domain."""
        for thread in self._threads:
            thread.stop()
        for thread in self._threads:
            thread.join()
        deadline = time.monotonic_ns() + ACKNOWLEDGED_NS
        for writer in self._reliable:
            writer._wait_for_acks(writer._ref, max(0, deadline - time.monotonic_ns()))
        self.participant._delete(self.participant._ref)

    def _start(self, reader: Any, pass_on: Callable[[], bool], name: str) -> None:
        thread = _ReaderThread(self._core, self.participant, reader, pass_on, name)
        self._threads.append(thread)
        thread.start()

    def _topic(self, topic: str, described: Any) -> Any:
        return self._topics.Topic(self.participant, topic, described)

    def _policies(self, qos: QoS, type_hash: str, writes: bool) -> Any:
        policy = self._core.Policy
        history = policy.History.KeepLast(max(1, qos.depth))
        policies = [
            history,
            policy.Reliability.Reliable(0) if qos.reliable else policy.Reliability.BestEffort,
            policy.Durability.TransientLocal if qos.latched else policy.Durability.Volatile,
            policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        ]
        if qos.latched:
            policies.append(policy.DurabilityService(0, history, -1, -1, -1))
        if type_hash:
            policies.append(policy.Userdata(f"typehash={type_hash};".encode()))
        if writes:
            policies.append(policy.WriterDataLifecycle(autodispose=False))
        return self._core.Qos(*policies)


class _Writer:
    """A writer of finished bytes; ``guid`` and ``handle`` identify it."""

    def __init__(self, clayer: Any, writer: Any, topic: str) -> None:
        self._clayer, self.entity, self._topic = clayer, writer, topic
        self.guid: bytes = writer.guid.bytes
        self.handle: int = writer.instance_handle & (2**64 - 1)

    def __call__(self, data: bytes) -> None:
        """Send the bytes of a message.

        Raises:
            BusError: when Cyclone DDS refuses them, or cannot take more now.
        """
        if missing := -len(data) % ALIGNMENT:
            data += bytes(missing)
        code = self._clayer.ddspy_write(self.entity._ref, data)
        if code == TIMEOUT:
            raise BusError(
                f"A message on {self._topic} was not sent: subscribers have not acknowledged those before.",
                "send less, or publish it as best effort",
            )
        if code < 0:
            raise BusError(f"DDS refused a message on {self._topic} (error {code}).", "open the bus again")


class _ReaderThread(threading.Thread):
    """A thread that waits for a reader's data and passes it on until it is stopped."""

    def __init__(self, core: Any, participant: Any, reader: Any, pass_on: Callable[[], bool], name: str) -> None:
        super().__init__(name=f"vlatool {name}", daemon=True)
        self._pass_on, self._errors, self._ended = pass_on, core.DDSException, False
        self._stop_condition = core.GuardCondition(participant)
        self._data_condition = core.ReadCondition(reader, ANY_STATE)
        self._waits = core.WaitSet(participant)
        self._waits.attach(self._stop_condition)
        self._waits.attach(self._data_condition)

    def run(self) -> None:
        """Pass data on until stopped, or until the domain is gone."""
        while not self._ended:
            try:
                self._waits.wait(FOREVER_NS)
                while not self._ended and self._pass_on():
                    pass
            except self._errors:
                return

    def stop(self) -> None:
        """End the thread after the message that it handles."""
        self._ended = True
        self._stop_condition.set(True)

    def join(self, timeout: float | None = None) -> None:
        """Wait for the thread's end; from within it, return at once."""
        if threading.current_thread() is not self:
            super().join(timeout)
