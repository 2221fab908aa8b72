"""What each protocol has: it begins to serve, says where, and ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from vlatool.errors import ServingError
from vlatool.serving._access import Access
from vlatool.serving._service import Service

EXTRA = "serve"
CLOSE_S = 2.0
"""How long the clients have to take the last answers when a server ends."""


class Endpoint:
    """Serves a policy in one protocol, in threads of its own.

    Args:
        service: Answers observations.
        access: Where, and for whom.
        port: TCP port; a free one when 0.
        on_kill: Called when a client asks the server to end, where the protocol has that.

    Raises:
        MissingExtra: when the package of the protocol is not installed.
    """

    default_port: ClassVar[int] = 0
    """Port that clients of the protocol use by default."""

    def __init__(self, service: Service, access: Access, port: int, on_kill: Callable[[], None] | None = None) -> None:
        self.service, self.access, self.port = service, access, port
        self.on_kill = on_kill

    def start(self) -> str:
        """Begin to serve; returns the address for a client.

        Raises:
            ServingError: when the port is in use or not allowed.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Take no more requests, and end within ``CLOSE_S`` and a second."""
        raise NotImplementedError

    def bind_error(self, error: OSError) -> ServingError:
        """Return the error for an address that cannot be served at."""
        reason = error.strerror or str(error)
        return ServingError(
            f"Nothing can be served at {self.access.host} port {self.port}: {reason}.",
            "give another port, or 0 for a free one: --port 0",
        )
