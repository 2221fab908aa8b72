"""Stand between ``/cmd_vel`` and the base: slow it down, or stop it, where a condition says so."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from vlatool.controllers._free_way import Mount
from vlatool.controllers._geometry import clamp, twist
from vlatool.controllers._interface import Command, Input, Output, Service, Snapshot
from vlatool.controllers._safety_facts import SENSORS, Memory, Robot, measure
from vlatool.controllers._safety_settings import check_settings, read_fence
from vlatool.controllers._safety_table import (
    SCALES,
    TABLE,
    Facts,
    Level,
    Limits,
    Rule,
    Status,
    conditions,
    highest,
    next_level,
    release,
)
from vlatool.controllers._settings import check_finite
from vlatool.errors import UsageError
from vlatool.messages import Message
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.sensor_msgs import BatteryState, Image, JointState, LaserScan
from vlatool.messages.std_msgs import Bool, String
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse

WORDS = 100
"""Words of danger that a step reads: none of them may be hidden by those that came after it."""


class _State(NamedTuple):
    status: Status = Status()
    memory: Memory = Memory()


@dataclass(frozen=True)
class SafetyMonitor:
    """Passes ``/cmd_vel`` on to ``/safe_cmd_vel``, at a share of its speed that the level of danger allows.

    ``_safety_table.TABLE`` has the conditions and their levels; NORMAL, WARNING, CRITICAL and EMERGENCY leave 1, 0.5,
    0.2 and 0 of the speed. A level rises at once and falls by one step a second once its condition is gone; EMERGENCY
    falls only when the service ``/safety_monitor/emergency`` is called with false, and true asks for it. A command
    counts for ``command_s``, and none does before each sensor in ``expects`` has come. A failure of the monitor is an
    EMERGENCY.

    It is not a safety-rated function: it runs on the computer of the robot, on sensors that are not safety-rated, and
    no standard was applied to it.

    Args:
        rate: Steps in a second.
        expects: Sensors that the robot has, of ``scan``, ``depth`` and ``odometry``, separated by commas; also
            ``person`` and ``emergency_stop``, where those are sent again and again: one that falls silent is out, too.
        radius_m: Radius of the base.
        margin_m: Distance kept to the sides of the way.
        warning_m, critical_m, emergency_m: Ways ahead up to which an obstacle counts for each level, in metres.
        camera_height_m, camera_forward_m: Place of the depth camera above the floor and before the centre of the base.
        camera_hfov_deg: Horizontal field of view of the depth camera, in degrees.
        scan_yaw_deg: Direction of the lidar's 0 degrees, to the left of the base's, in degrees: 90 on a TurtleBot 4.
        scan_forward_m: Place of the lidar before the centre of the base, in metres.
        top_m: Height up to which things are obstacles.
        cliff_m: Depth below the floor that is a cliff; things are obstacles from that height above it.
        max_linear_speed, max_angular_speed: Largest speeds passed on, in m/s and rad/s.
        max_age_s: Age of a sensor from which it is out, in seconds.
        command_s: Time for which a command counts, in seconds.
        silence_s: Time without a command that is a WARNING, in seconds.
        battery_warning, battery_critical, battery_emergency: Charges below which each level holds, from 0 to 1.
        current_critical_a, current_emergency_a: Motor currents above which each level holds, in the unit of
            ``/joint_states``.
        fence: ``X_MIN,Y_MIN,X_MAX,Y_MAX`` in the frame of the odometry, in metres; none when empty.
        fence_warning_m: Distance to the fence that is a WARNING, in metres.
        task_s: Time for which a task may run, in seconds.
        hold_at_start: Whether it begins with an EMERGENCY, for one that is restarted by itself.

    Raises:
        UsageError: for a setting out of its range.
    """

    rate: float = 20.0
    expects: str = "scan,depth,odometry"
    radius_m: float = 0.17
    margin_m: float = 0.04
    warning_m: float = 0.6
    critical_m: float = 0.4
    emergency_m: float = 0.25
    camera_height_m: float = 0.244
    camera_forward_m: float = 0.0
    camera_hfov_deg: float = 69.0
    scan_yaw_deg: float = 90.0
    scan_forward_m: float = -0.04
    top_m: float = 0.6
    cliff_m: float = 0.06
    max_linear_speed: float = 0.306
    max_angular_speed: float = 1.9
    max_age_s: float = 0.6
    command_s: float = 0.5
    silence_s: float = 1.0
    battery_warning: float = 0.2
    battery_critical: float = 0.1
    battery_emergency: float = 0.05
    current_critical_a: float = 3.0
    current_emergency_a: float = 6.0
    fence: str = ""
    fence_warning_m: float = 0.3
    task_s: float = 600.0
    hold_at_start: bool = False
    _robot: Robot = field(init=False, repr=False, compare=False)
    _table: tuple[Rule, ...] = field(default=TABLE, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_finite(self)
        check_settings(self)
        object.__setattr__(self, "_robot", self._describe())

    def _describe(self) -> Robot:
        expects = tuple(filter(None, (part.strip() for part in self.expects.split(","))))
        if absent := [name for name in expects if name not in SENSORS]:
            raise UsageError.unknown(f"Unknown sensor '{absent[0]}' in expects", absent[0], SENSORS)
        fence = read_fence(self.fence)
        if fence and "odometry" not in expects:
            raise UsageError(
                "There is a fence, and the odometry that says where the robot is is not expected.",
                "add odometry to expects, or leave fence out",
            )
        mount = Mount(self.camera_height_m, self.camera_forward_m, math.radians(self.camera_hfov_deg))
        limits = Limits(*(getattr(self, name) for name in Limits._fields))
        return Robot(
            expects, self.radius_m, self.margin_m, self.max_linear_speed, self.max_angular_speed, self.max_age_s, mount,
            math.radians(self.scan_yaw_deg), self.scan_forward_m, self.top_m, self.cliff_m, fence, limits,
        )  # fmt: skip

    @property
    def rate_hz(self) -> float:
        """Steps in a second."""
        return self.rate

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The command, and everything that says something about danger."""
        return (
            Input("cmd_vel", "/cmd_vel", Twist, required=False, reliable=True),
            Input("scan", "/scan", LaserScan, required=False),
            Input("depth", "/camera/depth/image_raw", Image, required=False),
            Input("odometry", "/odom", Odometry, required=False),
            Input("battery", "/battery_state", BatteryState, required=False),
            Input("joints", "/joint_states", JointState, required=False),
            Input("person", "/person_in_workspace", Bool, depth=WORDS, required=False),
            Input("task", "/vln/status", String, depth=WORDS, required=False, reliable=True),
            Input("emergency_stop", "/emergency_stop", Bool, depth=WORDS, required=False, reliable=True),
        )

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The velocity for the base, and the level with its reasons."""
        return (Output("safe_cmd_vel", "/safe_cmd_vel", Twist), Output("level", "/safety_monitor/level", String))

    @property
    def services(self) -> tuple[Service, ...]:
        """Ask for EMERGENCY with true, release it with false."""
        return (Service("emergency", "/safety_monitor/emergency", SetBoolRequest, SetBoolResponse),)

    def start(self) -> _State:
        """Return the state before anything was measured: at NORMAL, or at EMERGENCY where it holds at its start."""
        return _State(Status(Level.EMERGENCY if self.hold_at_start else Level.NORMAL))

    def step(self, snapshot: Snapshot, state: _State) -> tuple[Command, _State]:
        """Return the velocity for the base at this step; zero, and an EMERGENCY, where the monitor fails."""
        try:
            facts, memory = measure(snapshot, self._robot, state.memory)
            return self._judge(snapshot, facts, _State(state.status, memory))
        except Exception as error:
            return self._judge(snapshot, Facts(failure=True), state, f"{type(error).__name__}: {error}")

    def _judge(self, snapshot: Snapshot, facts: Facts, state: _State, failure: str = "") -> tuple[Command, _State]:
        """Return the command and the state for what was measured."""
        rules = conditions(facts, self._robot.limits, self._table)
        demand = highest(rules)
        status = next_level(state.status, demand, snapshot.time_s)
        responses: dict[int, Message] = {}
        for request in snapshot.requests:
            status, responses[request.number] = self._answer(request.message, status, demand, rules, snapshot.time_s)
        reasons = ", ".join(rule.name for rule in rules) + (f" ({failure})" if failure else "")
        waiting = [name for name in self._robot.expects if name not in snapshot.newest]
        command = twist() if failure or waiting or not facts.finite else self._scaled(snapshot, status.level)
        if waiting:
            reasons = f"waiting for {', '.join(waiting)}" + (f", {reasons}" if reasons else "")
        text = f"{status.level.name} {reasons}".strip()
        messages: dict[str, tuple[Message, ...]] = {"safe_cmd_vel": (command,), "level": (String(text),)}
        notes: dict[str, float | str] = {"level": float(status.level)}
        if math.isfinite(facts.clearance_m):
            notes["clearance_m"] = facts.clearance_m
        return Command(messages, responses, text, notes), state._replace(status=status)

    def _answer(
        self, request: Message, status: Status, demand: Level, rules: list[Rule], time_s: float
    ) -> tuple[Status, SetBoolResponse]:
        """Return the level and the response after a call of the service."""
        if getattr(request, "data", True):
            return Status(Level.EMERGENCY), SetBoolResponse(True, "EMERGENCY")
        after = release(status, demand, time_s)
        if after.level is Level.EMERGENCY:
            names = ", ".join(rule.name for rule in rules if rule.level is Level.EMERGENCY)
            return after, SetBoolResponse(False, f"EMERGENCY stays: {names}")
        return after, SetBoolResponse(True, after.level.name)

    def _scaled(self, snapshot: Snapshot, level: Level) -> Twist:
        """Return the newest command at the share of its speed that a level leaves, within the largest speeds."""
        command = snapshot.message("cmd_vel", Twist)
        if command is None or not snapshot.age_s("cmd_vel") <= self.command_s or level is Level.EMERGENCY:
            return twist()
        scale = SCALES[level]
        return twist(
            clamp(command.linear.x, self.max_linear_speed) * scale,
            clamp(command.angular.z, self.max_angular_speed) * scale,
        )

    def rest(self) -> Command:
        """Stand, and say so."""
        text = "EMERGENCY the monitor ended"
        return Command({"safe_cmd_vel": (twist(),), "level": (String(text),)}, status=text)
