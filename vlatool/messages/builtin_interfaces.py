"""Types of the ROS package ``builtin_interfaces``."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.schema import Message, int32, uint32


@dataclass(frozen=True, eq=False)
class Time(Message, name="builtin_interfaces/msg/Time"):
    """A moment: seconds and nanoseconds since the epoch of a clock."""

    sec: int32 = 0
    nanosec: uint32 = 0

    @property
    def seconds(self) -> float:
        """The moment in seconds."""
        return self.sec + self.nanosec * 1e-9

    @classmethod
    def from_seconds(cls, seconds: float) -> Time:
        """Return the moment that is this many seconds after the epoch, to a nanosecond."""
        nanoseconds = round(seconds * 1e9)
        return cls(nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)


@dataclass(frozen=True, eq=False)
class Duration(Message, name="builtin_interfaces/msg/Duration"):
    """A length of time: seconds and nanoseconds."""

    sec: int32 = 0
    nanosec: uint32 = 0

    @property
    def seconds(self) -> float:
        """The length in seconds."""
        return self.sec + self.nanosec * 1e-9

    @classmethod
    def from_seconds(cls, seconds: float) -> Duration:
        """Return a length of this many seconds, to a nanosecond."""
        nanoseconds = round(seconds * 1e9)
        return cls(nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)
