"""What controllers share that do nothing but drive a base."""

from __future__ import annotations

from vlatool.controllers._geometry import twist
from vlatool.controllers._interface import Command, Output, Service
from vlatool.messages.geometry_msgs import Twist


class BaseDriver:
    """A controller whose output is a velocity; a subclass is a dataclass with the setting ``rate``."""

    rate: float

    @property
    def rate_hz(self) -> float:
        """Steps in a second."""
        return self.rate

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Velocity."""
        return (Output("cmd_vel", "/cmd_vel", Twist),)

    @property
    def services(self) -> tuple[Service, ...]:
        """Nothing."""
        return ()

    def rest(self) -> Command:
        """Stand."""
        return Command({"cmd_vel": (twist(),)}, status="stopped")
