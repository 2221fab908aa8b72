"""Types of the ROS package ``unique_identifier_msgs``."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.schema import Message, uint8_16, zeros


@dataclass(frozen=True, eq=False)
class UUID(Message, name="unique_identifier_msgs/msg/UUID"):
    """An identifier, (16,) uint8, as RFC 4122 orders its bytes: ``uuid.uuid4().bytes``."""

    uuid: uint8_16 = zeros("uint8", 16)
