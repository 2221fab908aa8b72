"""A BabyAI level of MiniGrid as a floor on which a base drives: motion is continuous, the camera that of the level."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.errors import UsageError, require
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.pixels import image_message
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import Bool, Header, String
from vlatool.worlds import _mobile_messages as build
from vlatool.worlds._differential_drive import DifferentialDrive
from vlatool.worlds._faults import Outbox, read_knob
from vlatool.worlds._interface import Channel

SENSORS = {
    "color": Channel("/camera/color/image_raw", Image, 10.0),
    "depth": Channel("/camera/depth/image_raw", Image, 10.0),
    "odom": Channel("/odom", Odometry, 20.0),
    "instruction": Channel("/vln/instruction", String, 0.0),
    "arrived": Channel("/vln/arrived", Bool, 10.0),
}
"""Sensor -> its topic; the instruction is sent once."""
MAX_LINEAR, MAX_ANGULAR, LINEAR_RATE, ANGULAR_RATE, SILENCE_S = 0.306, 1.9, 0.9, 7.725, 0.5
"""The base of the TurtleBot 4; see ``turtlebot4``."""
TICK_S, TICKS = 0.01, 100.0
TILE = 8
"""Pixels of a tile of the camera's view of 7 x 7 tiles."""
FREE_M, FREE_RAD = 0.25, math.radians(15.0)
"""Share of a cell, and angle, within which the base counts as standing in a cell and facing its neighbour."""
RESTING = 0.02
"""Speed below which the base stands, in m/s and rad/s."""
DEPTH_PIXELS = 16


@dataclass
class BabyAI:
    """A BabyAI level whose cells are squares of a floor, on which a round base drives as it likes.

    The camera shows what MiniGrid draws for the nearest cell and heading, the depth camera how far the next wall or
    object is, straight ahead of the true pose. ``/vln/instruction`` tells the mission once. ``/vln/arrived`` is true
    while the base stands, and MiniGrid's own test of the mission, at the nearest cell and heading, holds: as the
    discrete environment ends an episode. Cells with an object, and walls, stop the base.

    Args:
        task: Name of the level, such as ``GoToLocalS6N3``.
        cell_m: Side of a cell, in metres.
        delay, drop, freeze: Faults of the sensors; see ``turtlebot4``.
        slip: Standard deviation of the odometry's error, as a share of each way and turn: of the run, and of each step.

    Raises:
        UsageError: for an unknown level, or a knob out of its range.
        MissingExtra: without MiniGrid.
    """

    task: str = "GoToLocalS6N3"
    cell_m: float = 1.0
    delay: str = "color=0.1,depth=0.1"
    drop: str = ""
    freeze: str = ""
    slip: float = 0.01
    _level: Any = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self._faults = [read_knob(name, getattr(self, name), SENSORS) for name in ("delay", "drop", "freeze")]
        if not 0.1 <= self.cell_m <= 10.0 or not 0.0 <= self.slip <= 1.0:
            raise UsageError(
                f"cell_m is {self.cell_m!r} and slip {self.slip!r}; allowed: 0.1 to 10, and 0 to 1.", "change them"
            )
        require("minigrid", "sim")
        gymnasium: Any = require("gymnasium", "sim")
        try:
            self._level = gymnasium.make(f"BabyAI-{self.task}-v0", disable_env_checker=True).unwrapped
        except gymnasium.error.Error as error:
            raise UsageError(f"MiniGrid has no level '{self.task}': {error}.", "write for example GoToLocal") from error
        self._level.gen_obs = dict  # the level's own observation, drawn at each step, is not used
        self.reset(0)

    @property
    def sensors(self) -> tuple[Channel, ...]:
        """Topics that it reports."""
        return tuple(SENSORS.values())

    @property
    def commands(self) -> tuple[Channel, ...]:
        """Velocity."""
        return (Channel("/cmd_vel", Twist),)

    @property
    def time_s(self) -> float:
        """Simulated time since the reset, in seconds."""
        return self._tick * TICK_S

    @property
    def max_actions(self) -> int:
        """Limit of actions of the level."""
        return int(self._level.max_steps)

    def reset(self, seed: int) -> None:
        """Start again, in the level of this seed."""
        with contextlib.redirect_stdout(io.StringIO()):  # MiniGrid prints when it draws again
            self._level.reset(seed=seed)
        x, y = (int(value) for value in self._level.agent_pos)
        self._pose = ((x + 0.5) * self.cell_m, -(y + 0.5) * self.cell_m, -self._level.agent_dir * math.pi / 2.0)
        self._tick, self._collisions, self._contact, self._success = 0, 0, False, False
        self._drive = DifferentialDrive(
            MAX_LINEAR, MAX_ANGULAR, LINEAR_RATE, ANGULAR_RATE, SILENCE_S, self.slip, np.random.default_rng([seed, 1])
        )
        delay, drop, freeze = self._faults
        self._outbox = Outbox(delay, drop, freeze, np.random.default_rng([seed, 3]))
        self._outbox.put("instruction", SENSORS["instruction"].topic, String(self._level.mission), 0.0)

    def advance(self, seconds: float) -> None:
        """Simulate this much time, in steps of 10 ms."""
        for _ in range(round(seconds / TICK_S)):
            self._step()
            for name, channel in SENSORS.items():
                if channel.rate_hz and self._tick % round(TICKS / channel.rate_hz) == 0:
                    self._outbox.put(name, channel.topic, self._message(name), self.time_s)

    def _step(self) -> None:
        """Drive for a tick, unless the way is blocked: the wheels turn all the same."""
        self._tick += 1
        self._drive.advance(TICK_S, self.time_s)
        x, y, yaw = self._pose
        middle = yaw + self._drive.angular * TICK_S / 2.0
        way = self._drive.linear * TICK_S
        position = (x + way * math.cos(middle), y + way * math.sin(middle))
        blocked = self._is_blocked(self._cell(*position))
        self._collisions += blocked and not self._contact
        self._contact = blocked
        x, y = (x, y) if blocked else position
        self._pose = (x, y, math.remainder(yaw + self._drive.angular * TICK_S, 2.0 * math.pi))
        self._success = self._success or self._has_arrived()

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        return math.floor(x / self.cell_m), math.floor(-y / self.cell_m)

    def _is_blocked(self, cell: tuple[int, int]) -> bool:
        thing = self._level.grid.get(*cell)
        return thing is not None and not thing.can_overlap()

    def _place_agent(self) -> None:
        """Put the agent of the level to the nearest cell and heading."""
        x, y, yaw = self._pose
        self._level.agent_pos = self._cell(x, y)
        self._level.agent_dir = round(-yaw / (math.pi / 2.0)) % 4

    def _has_arrived(self) -> bool:
        """Whether the base stands in a cell, faces its neighbour, and the mission is done."""
        if abs(self._drive.linear) > RESTING or abs(self._drive.angular) > RESTING:
            return False
        x, y, yaw = self._pose
        aside = max(abs(x / self.cell_m % 1.0 - 0.5), abs(-y / self.cell_m % 1.0 - 0.5))
        if aside > FREE_M or abs(math.remainder(yaw, math.pi / 2.0)) > FREE_RAD:
            return False
        self._place_agent()
        return bool(self._level.instrs.verify(self._level.actions.done) == "success")

    def _message(self, name: str) -> Message:
        stamp = Time.from_seconds(self.time_s)
        if name == "color":
            self._place_agent()
            pixels = self._level.get_frame(tile_size=TILE, agent_pov=True)
            return image_message(np.asarray(pixels, np.uint8), "rgb8", Header(stamp, "camera"))
        if name == "depth":
            depth = np.full((DEPTH_PIXELS, DEPTH_PIXELS), self._ahead(), np.float32)
            return image_message(depth, "32FC1", Header(stamp, "camera"))
        if name == "odom":
            return build.odometry(self._drive.odometry, self._drive.linear, self._drive.angular, stamp)
        return Bool(self._has_arrived())

    def _ahead(self) -> float:
        """Return how far the next cell that is not free is ahead of the base, in metres."""
        x, y, yaw = self._pose
        step, cos, sin = self.cell_m / 50.0, math.cos(yaw), math.sin(yaw)
        for count in range(50 * 30):
            if self._is_blocked(self._cell(x + count * step * cos, y + count * step * sin)):
                return count * step
        return math.inf

    def reports(self) -> list[tuple[str, Message]]:
        """Return the messages that arrived since the last call, with their topics, in the order of their sending."""
        return self._outbox.take(self.time_s)

    def obey(self, topic: str, message: Message) -> None:
        """Take a velocity.

        Raises:
            UsageError: for another topic or message.
        """
        if topic != "/cmd_vel" or not isinstance(message, Twist):
            raise UsageError(
                f"babyai does not obey {type(message).__name__} on {topic}; allowed: Twist on /cmd_vel.",
                "map the topic of the controller",
            )
        self._drive.obey(message.linear.x, message.angular.z, self.time_s)

    def truth(self) -> Mapping[str, Any]:
        """Return ``pose`` (x, y, yaw), ``velocity``, ``collisions``, ``success`` (ever) and ``arrived`` (now)."""
        return {
            "pose": self._pose,
            "velocity": (float(self._drive.linear), float(self._drive.angular)),
            "collisions": self._collisions,
            "success": self._success,
            "arrived": self._has_arrived(),
        }
