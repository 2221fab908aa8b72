"""A TurtleBot 4 in a room of primitives: a round differential drive with an RGB-D camera and a lidar."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.errors import UsageError
from vlatool.messages import Message
from vlatool.messages.geometry_msgs import Twist
from vlatool.worlds._differential_drive import DifferentialDrive
from vlatool.worlds._faults import Outbox, read_knob
from vlatool.worlds._indoor_scene import Scene, Thing, draw_scene, model_text
from vlatool.worlds._interface import Channel
from vlatool.worlds._simulation import advance_model, load_mujoco
from vlatool.worlds._turtlebot4_sensors import CAMERA_HEIGHT_M, HFOV_RAD, SENSORS, Sensors
from vlatool.worlds._walkers import Walkers

RADIUS_M = 0.17
"""Radius of a Create 3 (its documentation, "Hardware": 341.9 mm in diameter)."""
MAX_LINEAR, MAX_ANGULAR = 0.306, 1.9
"""Speeds of a Create 3 with its safety on, in m/s and rad/s (its documentation, "Safety")."""
LINEAR_RATE, ANGULAR_RATE = 0.9, 7.725
"""Accelerations: ``wheel_accel_limit`` of a Create 3, and that of its simulator, in m/s^2 and rad/s^2."""
SILENCE_S = 0.5
"""Time without a command after which the base stops by itself."""
TICK_S = 0.01
TARGET = Thing("target", 0.0, 0.0, 0.12, 0.6)
ROBOT = (
    f'<geom type="cylinder" pos="0 0 0.06" size="{RADIUS_M} 0.05" mass="3.9" group="3" contype="1" conaffinity="1"/>'
)

RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("pillars", "cliffs", "movers", "people"), (0, 999)), "intruder_s": (0.0, 1e6),
    "yield_m": (0.0, 10.0), "gaps": (0.0, 1.0), "target_m": (0.0, 50.0), "target_speed": (0.0, 10.0),
    "size_m": (2.0, 50.0), "width": (8, 640), "height": (8, 480), "battery": (0.0, 1.0),
}  # fmt: skip
"""Knob -> its least and largest value; MuJoCo's picture has 640 x 480 pixels at most."""


@dataclass
class TurtleBot4:
    """A TurtleBot 4 at the origin of a square room, as it reports itself and obeys ``/cmd_vel``.

    Frames are those of ROS: x forward, y to the left; the optical frame of the camera has x to the right, y down and z
    forward. Its speeds and accelerations are those of its base, a Create 3, which stops by itself 0.5 s after the last
    command. It cannot fall: ``truth()["fell"]`` says that its centre was above a pit.

    Args:
        size_m: Side of the room, in metres.
        pillars, cliffs, movers, people: How many of each are in the room. Those that move give way at ``yield_m``.
        yield_m: Distance from the robot's edge within which moving things come no nearer, in metres.
        intruder_s: Every how many seconds, on average, something steps in 0.5 m in front of the robot's centre, for
            three seconds; 0 for never.
        target_m: Distance ahead of the robot at which a red target stands at the start, in metres; 0 for none.
        target_speed: Speed at which it walks through the room while the robot is within 1.5 m of it, in m/s.
        command_topic: Topic of commands; ``/safe_cmd_vel`` behind a safety monitor.
        only: Sensors that are simulated, separated by commas; all when empty. Cameras are rendered when asked for.
        width, height: Pixels of the camera.
        delay: Seconds until a message arrives, for all sensors or ``SENSOR=SECONDS`` separated by commas.
        drop: Share of messages that are lost, in the same form.
        freeze: Share of messages after which the content of that one is sent again for half a second.
        gaps: Share of the lidar's turn that has no ranges, in one piece that is drawn for each scan.
        noise: Standard deviations: ``color`` in grey levels, ``depth`` and ``odom`` (slip) as shares, ``scan`` in
            metres, ``imu`` in rad/s and m/s^2.
        battery: Charge at the start, from 0 to 1.

    Raises:
        UsageError: for a knob out of its range.
        MissingExtra: without MuJoCo.
        InstallationError: where nothing renders, and a camera is asked for.
    """

    size_m: float = 6.0
    pillars: int = 6
    cliffs: int = 0
    movers: int = 0
    people: int = 0
    yield_m: float = 0.4
    intruder_s: float = 0.0
    target_m: float = 0.0
    target_speed: float = 0.0
    command_topic: str = "/cmd_vel"
    only: str = ""
    width: int = 160
    height: int = 120
    delay: str = ""
    drop: str = ""
    freeze: str = ""
    gaps: float = 0.0
    noise: str = "color=2,depth=0.01,scan=0.01,imu=0.01,odom=0.01"
    battery: float = 0.9
    _knobs: dict[str, dict[str, float]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("delay", "drop", "freeze", "noise"):
            self._knobs[name] = read_knob(name, getattr(self, name), SENSORS)
        for name, (low, high) in RANGES.items():
            if not low <= getattr(self, name) <= high:
                allowed = f"from {low:g} to {high:g}"
                raise UsageError(f"{name} is {getattr(self, name)!r}; allowed: {allowed}.", f"change {name}")
        self._names = tuple(filter(None, (part.strip() for part in self.only.split(",")))) or tuple(SENSORS)
        if absent := [name for name in self._names if name not in SENSORS]:
            raise UsageError.unknown(f"Unknown sensor '{absent[0]}' in only", absent[0], SENSORS)
        self._mujoco = load_mujoco()
        self.reset(0)

    @property
    def sensors(self) -> tuple[Channel, ...]:
        """Topics that it reports."""
        return tuple(SENSORS[name] for name in self._names)

    @property
    def commands(self) -> tuple[Channel, ...]:
        """Velocity."""
        return (Channel(self.command_topic, Twist),)

    @property
    def time_s(self) -> float:
        """Simulated time since the reset, in seconds."""
        return self._tick * TICK_S

    def reset(self, seed: int) -> None:
        """Start again, from a scene and noise of this seed."""
        self._random = np.random.default_rng(seed)
        counts = {name: int(getattr(self, name)) for name in ("pillars", "cliffs", "movers", "people")}
        self._scene: Scene = draw_scene(self.size_m, counts, self._random)
        fovy = math.degrees(2.0 * math.atan(math.tan(HFOV_RAD / 2.0) * self.height / self.width))
        camera = f'<camera name="front" pos="0 0 {CAMERA_HEIGHT_M}" xyaxes="0 -1 0 0 0 1" fovy="{fovy}"/>'
        self._model = self._mujoco.MjModel.from_xml_string(model_text(self._scene, ROBOT, camera, TARGET))
        self._data = self._mujoco.MjData(self._model)
        self._tick, self._collisions, self._contact, self._fell = 0, 0, False, False
        self._target: tuple[float, float] | None = None
        self._intruder_until = 0.0
        self._yaw = float(self._random.uniform(-math.pi, math.pi))
        self._data.qpos[:3] = (0.0, 0.0, self._yaw)
        slip = self._knobs["noise"].get("odom", 0.0)
        self._drive = DifferentialDrive(
            MAX_LINEAR, MAX_ANGULAR, LINEAR_RATE, ANGULAR_RATE, SILENCE_S, slip, np.random.default_rng([seed, 1])
        )
        self._walkers = Walkers(self._scene, self.yield_m, RADIUS_M, np.random.default_rng([seed, 2]))
        faults = (self._knobs["delay"], self._knobs["drop"], self._knobs["freeze"], np.random.default_rng([seed, 3]))
        if hasattr(self, "_sensors"):
            self._sensors.close()
        self._sensors: Sensors = Sensors(
            self._mujoco, self._model, self._names, (self.height, self.width), self._knobs["noise"], self.gaps,
            Outbox(*faults), np.random.default_rng([seed, 4]), self.battery,
        )  # fmt: skip
        if self.target_m:
            self.place_target(self.target_m * math.cos(self._yaw), self.target_m * math.sin(self._yaw))
        self._goal: tuple[float, float] | None = None
        self._mujoco.mj_forward(self._model, self._data)

    def place_target(self, x: float, y: float) -> None:
        """Put the red target to a place of the room, in metres; it is hidden before."""
        self._target = (x, y)
        self._place("target", x, y, 0.0)

    def hide_target(self) -> None:
        """Take the target away."""
        self._target = None
        self._place("target", 0.0, 0.0, -10.0)

    def _place(self, name: str, x: float, y: float, z: float) -> None:
        body = self._mujoco.mj_name2id(self._model, self._mujoco.mjtObj.mjOBJ_BODY, name)
        self._data.mocap_pos[self._model.body_mocapid[body]] = (x, y, z)

    def advance(self, seconds: float) -> None:
        """Simulate this much time, in steps of 10 ms."""
        for _ in range(round(seconds / TICK_S)):
            self._step()
            self._sensors.sense(self._tick, self._data, self._drive, self._target, self._people_near(), self._contact)

    def _step(self) -> None:
        self._tick += 1
        now, drive, data = self.time_s, self._drive, self._data
        drive.advance(TICK_S, now)
        x, y, yaw = (float(value) for value in data.qpos[:3])
        data.qvel[:3] = (drive.linear * math.cos(yaw), drive.linear * math.sin(yaw), drive.angular)
        self._walkers.advance(TICK_S, (x, y))
        for name, (px, py) in self._walkers.places.items():
            self._place(name, px, py, 0.0)
        self._intrude(x, y, yaw)
        self._lead(x, y)
        advance_model(self._mujoco, self._model, data)
        touching = data.ncon > 0
        if touching and not self._contact and abs(drive.linear) > 0.01:
            self._collisions += 1
        self._contact = touching
        self._fell = self._fell or any(p.left < x < p.right and p.low < y < p.high for p in self._scene.pits)

    def _intrude(self, x: float, y: float, yaw: float) -> None:
        """Let something step in front of the robot, or away again."""
        if not self.intruder_s:
            return
        if self._intruder_until and self.time_s > self._intruder_until:
            self._intruder_until = 0.0
            self._place("intruder", 0.0, 0.0, -10.0)
        elif not self._intruder_until and self._random.random() < TICK_S / self.intruder_s:
            self._intruder_until = self.time_s + 3.0
            ahead = math.copysign(0.6, self._drive.linear or 1.0)
            self._place("intruder", x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), 0.0)

    def _lead(self, x: float, y: float) -> None:
        """Let the target walk on while the robot is near."""
        if self._target is None or not self.target_speed:
            return
        tx, ty = self._target
        if self._goal is None or math.hypot(self._goal[0] - tx, self._goal[1] - ty) < 0.1:
            reach = self.size_m / 2.0 - 0.5
            self._goal = (float(self._random.uniform(-reach, reach)), float(self._random.uniform(-reach, reach)))
        way = math.hypot(self._goal[0] - tx, self._goal[1] - ty)
        step = min(self.target_speed * TICK_S, way) / max(way, 1e-9)
        new = (tx + (self._goal[0] - tx) * step, ty + (self._goal[1] - ty) * step)
        if math.hypot(tx - x, ty - y) < 1.5 and math.hypot(new[0] - x, new[1] - y) > RADIUS_M + TARGET.radius + 0.1:
            self.place_target(*new)

    def _people_near(self) -> bool:
        """Whether a person is within 1.2 m of the robot's edge."""
        x, y = self._data.qpos[:2]
        return any(
            math.hypot(px - x, py - y) < RADIUS_M + 1.2
            for name, (px, py) in self._walkers.places.items()
            if name.startswith("person")
        )

    def reports(self) -> list[tuple[str, Message]]:
        """Return the messages that arrived since the last call, with their topics, in the order of their sending."""
        return self._sensors.outbox.take(self.time_s)

    def obey(self, topic: str, message: Message) -> None:
        """Take a velocity.

        Raises:
            UsageError: for another topic or message.
        """
        if topic != self.command_topic or not isinstance(message, Twist):
            raise UsageError(
                f"turtlebot4 does not obey {type(message).__name__} on {topic}; allowed: Twist on "
                f"{self.command_topic}.",
                "map the topic of the controller, or set command_topic",
            )
        self._drive.obey(message.linear.x, message.angular.z, self.time_s)

    def truth(self) -> Mapping[str, Any]:
        """Return ``pose`` (x, y, yaw), ``velocity`` (m/s, rad/s), ``contact``, ``collisions``, ``fell``, ``target``.

        ``collisions`` counts contacts that began while the wheels turned to drive. ``target`` is (distance, bearing)
        from the camera, in metres and radians to the left, or None.
        """
        x, y, yaw = (float(value) for value in self._data.qpos[:3])
        target = None
        if self._target is not None:
            dx, dy = self._target[0] - x, self._target[1] - y
            target = (math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - yaw, 2.0 * math.pi))
        return {
            "pose": (x, y, math.remainder(yaw, 2.0 * math.pi)),
            "velocity": (self._drive.linear, self._drive.angular),
            "contact": self._contact,
            "collisions": self._collisions,
            "fell": self._fell,
            "target": target,
        }
