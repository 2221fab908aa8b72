"""Services over DDS as rmw_cyclonedds has them: a topic of requests, one of replies, and a header in both.

Fast DDS carries the same in fields of its protocol that Cyclone DDS does not pass on, so services, unlike topics, work
only between nodes that use Cyclone DDS.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar, cast

from vlatool.buses._dds_types import describe_service_part
from vlatool.buses._faults import Faults
from vlatool.buses._interface import QoS
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.cdr import HEADER, decode, encode
from vlatool.messages.type_hash import rihs01

M = TypeVar("M", bound=Message)
SERVICE_QOS = QoS(reliable=True, depth=10)
"""ROS 2's quality of service for services (rmw_qos_profile_services_default)."""
REQUEST = struct.Struct("<Qq")
"""Whose request it is (handle of the client's writer), and its number; Cyclone DDS hands over little endian."""
MATCH_S, POLL_S = 0.1, 0.002
"""How long a server waits for the client's reader, as rmw_cyclonedds does, and how often it looks."""


def serve_requests(
    endpoints: Any,
    service: str,
    request: type[Message],
    response: type[M],
    handler: Callable[[Message], M],
    faults: Faults,
) -> tuple[bytes, bytes]:
    """Answer a service, each request in a thread, until the endpoints are closed.

    Returns:
        The identifiers of its reader and its writer.
    """
    write = endpoints.writer(f"rr{service}Reply", describe_service_part(response), SERVICE_QOS, rihs01(response))

    def answer_request(data: bytes) -> None:
        try:
            header, asked = _split(data, request)
            answer = encode(handler(asked))
            _wait_until(lambda: bool(write.entity.get_matched_subscriptions()), time.monotonic() + MATCH_S)
            write(HEADER + header + answer[len(HEADER) :])
        except Exception as error:  # a handler may raise anything; the bus goes on
            faults.add_raised(service, error)

    def handle(data: bytes, _: float) -> None:
        threading.Thread(target=answer_request, args=(data,), name=f"vlatool {service}", daemon=True).start()

    topic = f"rq{service}Request"
    reader = endpoints.reader(topic, describe_service_part(request), SERVICE_QOS, rihs01(request), handle)
    return reader.guid.bytes, write.guid


class Client:
    """What calls one service: a writer of requests and a reader of replies.

    Args:
        endpoints: What makes readers and writers.
        service: Full name of the service.
        request: Type of the requests.
        response: Type of the responses.
        faults: Where malformed replies are counted.
    """

    def __init__(
        self, endpoints: Any, service: str, request: type[Message], response: type[Message], faults: Faults
    ) -> None:
        self._service, self._response, self._faults = service, response, faults
        self._replied = threading.Condition()
        self._replies: dict[int, Message] = {}
        self._awaited: set[int] = set()
        self._number = 0
        described = describe_service_part(response)
        reader = endpoints.reader(f"rr{service}Reply", described, SERVICE_QOS, rihs01(response), self._hear)
        topic = f"rq{service}Request"
        self._write = endpoints.writer(topic, describe_service_part(request), SERVICE_QOS, rihs01(request))
        self._reader, self.reader_guid, self.writer_guid = reader, reader.guid.bytes, self._write.guid

    def call(self, request: Message, response: type[M], deadline_s: float, timeout_s: float) -> M:
        """Return the answer to a request.

        Raises:
            BusError: when nobody serves, or answers, by the deadline, by ``time.monotonic``.
        """
        if response is not self._response:
            problem = f"The service {self._service} was called for a {self._response.TYPE}, now for a {response.TYPE}."
            raise BusError(problem, "correct the type")
        if not _wait_until(self._served, deadline_s):
            raise BusError(f"Nobody served {self._service} within {timeout_s:g} s.", "start the node that serves it")
        with self._replied:
            self._number += 1
            number = self._number
            self._awaited.add(number)
        self._write(HEADER + REQUEST.pack(self._write.handle, number) + encode(request)[len(HEADER) :])
        with self._replied:
            remaining_s = max(0.0, deadline_s - time.monotonic())
            self._replied.wait_for(lambda: number in self._replies, remaining_s)
            self._awaited.discard(number)
            answer = self._replies.pop(number, None)
        if answer is None:
            raise BusError(f"{self._service} did not answer within {timeout_s:g} s.", "see the node that serves it")
        return cast(M, answer)  # of the class that was checked above

    def _served(self) -> bool:
        return bool(self._write.entity.get_matched_subscriptions() and self._reader.get_matched_publications())

    def _hear(self, data: bytes, _: float) -> None:
        try:
            header, answer = _split(data, self._response)
        except BusError as error:
            self._faults.add(self._service, error)
            return
        client, number = REQUEST.unpack(header)
        with self._replied:
            if client == self._write.handle and number in self._awaited:
                self._replies[number] = answer
                self._replied.notify_all()


def _split(data: bytes, cls: type[M]) -> tuple[bytes, M]:
    """Return the header of a request or a response, and the message behind it."""
    end = len(HEADER) + REQUEST.size
    if len(data) < end:
        raise BusError(f"A malformed {cls.TYPE}: {len(data)} bytes.", "check that the node uses rmw_cyclonedds_cpp")
    return data[len(HEADER) : end], decode(cls, data[: len(HEADER)] + data[end:])


def _wait_until(holds: Callable[[], bool], deadline_s: float) -> bool:
    while not holds():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(POLL_S)
    return True
