"""Open a Zenoh session as ROS 2 nodes do: a peer that meets the others at a router, without multicast."""

from __future__ import annotations

import json
import os
import re
from typing import Any

from vlatool.errors import BusError, UsageError, require

DEFAULT = "tcp/localhost:7447"
"""Where rmw_zenoh expects the router."""
CONFIG = "ZENOH_SESSION_CONFIG_URI"
"""Environment variable with the file of settings that rmw_zenoh's nodes read."""
ROUTER = "router/"
"""Prefix of an address at which this node is the router."""
ENDPOINT = re.compile(r"(tcp|tls|quic|udp|ws|unixsock-stream|serial|vsock)/\S+")
TIMEOUT_MS = 3000
"""How long a router may take to answer."""


def open_session(address: str) -> Any:
    """Return a session at a router, or one that is the router.

    Args:
        address: Endpoint of the router, such as ``tcp/127.0.0.1:7447``; behind ``router/``, the endpoint at which
            this session is the router; empty for where rmw_zenoh expects the router.

    Raises:
        UsageError: for what is not an endpoint.
        MissingExtra: when eclipse-zenoh is absent.
        BusError: when no router answers within three seconds, or this session cannot be the router there.
    """
    serves = address.startswith(ROUTER)
    endpoint = address.removeprefix(ROUTER) or DEFAULT
    if not ENDPOINT.fullmatch(endpoint):
        raise UsageError(
            f"'{address}' is not an endpoint of Zenoh: protocol, slash, address.",
            "write zenoh:tcp/127.0.0.1:7447, or zenoh:router/tcp/127.0.0.1:7447 for a node that is the router",
        )
    zenoh = require("zenoh", "zenoh")
    try:
        return zenoh.open(_settings(zenoh, endpoint, serves, bool(address)))
    except zenoh.ZError as error:
        raise _unreachable(endpoint, serves, error) from error


def _settings(zenoh: Any, endpoint: str, serves: bool, chosen: bool) -> Any:
    file = os.environ.get(CONFIG, "")
    if not file:
        settings = zenoh.Config()
        values = _values(endpoint, serves)
    else:
        try:
            settings = zenoh.Config.from_file(file)
        except zenoh.ZError as error:
            raise UsageError(f"{CONFIG} names '{file}', which Zenoh cannot read: {error}", "correct it") from error
        values = {"connect/endpoints": [endpoint]} if chosen and not serves else {}
        values |= _values(endpoint, serves) if serves else {}
    for key, value in values.items():
        settings.insert_json5(key, json.dumps(value))
    return settings


def _values(endpoint: str, serves: bool) -> dict[str, Any]:
    shared: dict[str, Any] = {
        "scouting/multicast/enabled": False, "scouting/gossip/enabled": True, "scouting/delay": 1,
        "timestamping/enabled": True,
    }  # fmt: skip
    if serves:
        return {**shared, "mode": "router", "listen/endpoints": [endpoint], "connect/endpoints": []}
    host = "tcp/127.0.0.1:0" if re.search(r"/(127\.|localhost)", endpoint) else "tcp/[::]:0"
    return {
        **shared, "mode": "peer", "connect/endpoints": [endpoint], "connect/timeout_ms": TIMEOUT_MS,
        "connect/exit_on_failure": True, "listen/endpoints": [host],
    }  # fmt: skip


def _unreachable(endpoint: str, serves: bool, error: Exception) -> BusError:
    reason = str(error).partition(" at ")[0]
    if serves:
        return BusError(
            f"This node cannot be Zenoh's router at {endpoint}: {reason}.",
            "choose a free port, or leave 'router/' out to use the router that runs there",
        )
    return BusError(
        f"No router of Zenoh answers at {endpoint} within {TIMEOUT_MS / 1000:g} s: {reason}.",
        f"start one (ros2 run rmw_zenoh_cpp rmw_zenohd, or zenohd), or let one node be it: zenoh:router/{endpoint}",
    )
