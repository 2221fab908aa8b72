"""The ROS 1 master: its address, and questions to it that never take longer than a few seconds."""

from __future__ import annotations

import http.client
import os
import socket
import xmlrpc.client
from typing import Any
from urllib.parse import urlsplit

from vlatool.buses._interface import TopicInfo
from vlatool.errors import BusError, UsageError

DEFAULT = "http://127.0.0.1:11311"
TIMEOUT_S = 3.0
ANY_TYPE = "*"
START = (
    "start a master with `roscore` (`rosmaster --core` of the Debian package python3-rosmaster), or name another one: "
    "ros1:http://HOST:11311"
)


def master_uri(address: str) -> str:
    """Return the address of a master: what the user gives, else ``ROS_MASTER_URI``, else that of this machine.

    Raises:
        UsageError: when it is none, such as ``ros1:11311``.
    """
    text = address or os.environ.get("ROS_MASTER_URI", "") or DEFAULT
    uri = text if "://" in text else f"http://{text}"
    try:
        parts = urlsplit(uri)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme != "http" or not parts.hostname or port is None:
        raise UsageError(
            f"'{text}' is not the address of a ROS 1 master; it has a host and a port.",
            "write ros1:http://HOST:11311, or ros1 alone for ROS_MASTER_URI",
        )
    return uri


def own_address(uri: str) -> str:
    """Return the address at which this machine is reached from a master, an IPv4 address; empty where none is found.

    rospy would tell other nodes this machine's host name, which they often cannot resolve; then no message arrives, and
    nothing says why.
    """
    parts = urlsplit(uri)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
        try:
            route.connect((parts.hostname or "", parts.port or 0))  # sends nothing
        except OSError:
            return ""
        address: str = route.getsockname()[0]
    return address


class _Transport(xmlrpc.client.Transport):
    """A connection that gives up after some seconds."""

    def __init__(self, timeout_s: float) -> None:
        super().__init__()
        self._timeout_s = timeout_s

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        """Return the connection, with its time-out."""
        connection = super().make_connection(host)
        connection.timeout = self._timeout_s
        return connection


class Master:
    """Asks a master; a new connection for each question, so that any thread may.

    Args:
        uri: Address of the master.
        caller: Full name of this node.
    """

    def __init__(self, uri: str, caller: str) -> None:
        self.uri, self.caller = uri, caller

    def ask(self, method: str, *arguments: Any, timeout_s: float = TIMEOUT_S) -> Any:
        """Return what the master answers; None when it says that it does not know.

        Raises:
            BusError: when no master answers in time.
        """
        return ask(self.uri, method, self.caller, *arguments, timeout_s=timeout_s)

    def topics(self) -> list[TopicInfo]:
        """Return what is registered: topics that somebody publishes or subscribes to, sorted by name.

        Raises:
            BusError: when no master answers in time.
        """
        publishers, subscribers, _ = self.ask("getSystemState")
        types = dict(self.ask("getTopicTypes"))
        pubs, subs = dict(publishers), dict(subscribers)
        return [
            TopicInfo(name, _types(types.get(name, ANY_TYPE)), tuple(pubs.get(name, ())), tuple(subs.get(name, ())))
            for name in sorted(pubs | subs)
        ]

    def refuse_other_type(self, topic: str, name: str) -> None:
        """Raise BusError when a topic that another node uses carries another type than that of this ROS 2 name."""
        for info in self.topics():
            others = {*info.publishers, *info.subscribers} - {self.caller}
            if info.topic == topic and others and info.types and name not in info.types:
                users = ", ".join(sorted(others))
                raise BusError(
                    f"The topic {topic} carries {info.types[0]}, not {name}; it is used by {users}.",
                    "map the topic to another name, or stop that node",
                )

    def refuse_namesake(self) -> None:
        """Raise BusError when a node of the same name answers: the master would end it without a word."""
        uri = self.ask("lookupNode", self.caller)
        if not uri:
            return
        try:
            ask(uri, "getPid", self.caller, timeout_s=1.0)
        except BusError:
            return  # what is left of a node that was killed
        raise BusError(
            f"A node with the name {self.caller} runs on this master already, at {uri}.",
            f"stop it (rosnode kill {self.caller}), or give this one another name",
        )

    def refuse_second_server(self, service: str) -> None:
        """Raise BusError when a server of a service can be reached."""
        uri = self.ask("lookupService", service)
        if not uri:
            return
        parts = urlsplit(uri)
        try:
            socket.create_connection((parts.hostname or "", parts.port or 0), 1.0).close()
        except OSError:
            return
        raise BusError(f"The service {service} is served already, at {uri}.", "stop that node, or rename the service")


def ask(uri: str, method: str, *arguments: Any, timeout_s: float = TIMEOUT_S) -> Any:
    """Return what a master or a node answers over XML-RPC; None when it says that it does not know.

    Raises:
        BusError: when nobody answers in time, or something else than ROS 1 does.
    """
    try:
        with xmlrpc.client.ServerProxy(uri, transport=_Transport(timeout_s)) as server:
            answer: Any = getattr(server, method)(*arguments)
        code, _, value = answer
        return value if code == 1 else None
    except (OSError, http.client.HTTPException) as error:
        why = f"nobody answered within {timeout_s:g} s" if isinstance(error, TimeoutError) else _reason(error)
        raise BusError(f"No ROS 1 master answers at {uri}: {why}.", START) from None
    except (xmlrpc.client.Error, TypeError, ValueError, SyntaxError) as error:
        what = " ".join(str(error).split())[:100]
        raise BusError(f"What answers at {uri} is not a ROS 1 master: {what}.", START) from None
    except Exception as error:  # expat's error, which has no base class but this
        raise BusError(f"What answers at {uri} is not a ROS 1 master: {str(error)[:100]}.", START) from None


def _reason(error: Exception) -> str:
    words = " ".join((getattr(error, "strerror", None) or str(error)).split())[:100]
    return words.rstrip(".").lower() or type(error).__name__


def _types(name: str) -> tuple[str, ...]:
    """Return the ROS 2 name of a type of ROS 1; nothing where nobody has stated it."""
    return () if name == ANY_TYPE else (name.replace("/", "/msg/", 1),)
