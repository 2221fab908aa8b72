"""Types of the ROS package ``builtin_interfaces``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from vlatool.messages.schema import Message, int32, uint32

S = TypeVar("S", bound="_Seconds")


@dataclass(frozen=True, eq=False)
class _Seconds(Message):
    """Seconds and nanoseconds."""

    sec: int32 = 0
    nanosec: uint32 = 0

    @property
    def seconds(self) -> float:
        """The same as one number."""
        return self.sec + self.nanosec * 1e-9

    @classmethod
    def from_seconds(cls: type[S], seconds: float) -> S:
        """Return the value that is this many seconds, to a nanosecond."""
        nanoseconds = round(seconds * 1e9)
        return cls(nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)


@dataclass(frozen=True, eq=False)
class Time(_Seconds, name="builtin_interfaces/msg/Time"):
    """A moment: seconds and nanoseconds since the epoch of a clock."""


@dataclass(frozen=True, eq=False)
class Duration(_Seconds, name="builtin_interfaces/msg/Duration"):
    """A length of time."""
