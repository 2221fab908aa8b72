"""The graph of a Zenoh bus: the liveliness tokens of ROS 2's nodes, as they come and go."""

from __future__ import annotations

from typing import Any

from vlatool.buses._faults import Faults
from vlatool.buses._graph import Graph
from vlatool.buses._zenoh_keys import SPACE, parse

FIRST_LOOK_S = 3.0
"""How long the router may take to list the tokens that are there."""


class ZenohGraph(Graph):
    """Publishers, subscribers, services and clients of the nodes with rmw_zenoh.

    Args:
        zenoh: The library.
        session: An open session.
        domain: ROS domain.
        faults: Where what does not fit on one of this node's topics is counted.
    """

    def __init__(self, zenoh: Any, session: Any, domain: int, faults: Faults) -> None:
        super().__init__(str(session.info.zid()), faults)
        self._zenoh = zenoh
        pattern = f"{SPACE}/{domain}/**"
        heard = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber = session.liveliness().declare_subscriber(pattern, heard, history=True)
        for reply in session.liveliness().get(pattern, timeout=FIRST_LOOK_S):
            if reply.ok is not None:
                self.add_token(str(reply.ok.key_expr))

    def close(self) -> None:
        """Listen no longer."""
        self._subscriber.undeclare()

    def add_token(self, token: str) -> None:
        """Take in what a token describes."""
        entity = parse(token)
        if entity is not None:
            self.add(token, entity)

    def _hear(self, sample: Any) -> None:
        token = str(sample.key_expr)
        if sample.kind == self._zenoh.SampleKind.PUT:
            self.add_token(token)
        else:
            self.remove(token)
