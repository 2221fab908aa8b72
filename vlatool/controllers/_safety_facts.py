"""What a safety monitor measures at a step, and what it remembers for the next."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.controllers import _free_way as free_way
from vlatool.controllers._freshness import Change, age_s, note_changes
from vlatool.controllers._geometry import PlanarPose, clamp, pose_of, wrap
from vlatool.controllers._interface import Snapshot
from vlatool.controllers._safety_table import Facts, Limits
from vlatool.controllers._sensor_arrays import rays_of, thin_depth_of
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.sensor_msgs import BatteryState, Image, JointState, LaserScan
from vlatool.messages.std_msgs import Bool, String

Array = NDArray[Any]
SENSORS = ("scan", "depth", "odometry", "person", "emergency_stop")
LEGAL = {
    "idle": {"running"},
    "running": {"idle", "paused", "arrived", "failed"},
    "paused": {"idle", "running", "failed"},
    "arrived": {"idle", "running"},
    "failed": {"idle", "running"},
}
"""State of a task -> states that may follow; each may follow itself, and a task begins with any of them."""


class Robot(NamedTuple):
    """What the monitor is told about the robot; see ``SafetyMonitor``."""

    expects: tuple[str, ...]
    radius_m: float
    margin_m: float
    max_linear: float
    max_angular: float
    max_age_s: float
    mount: free_way.Mount
    scan_yaw: float
    scan_forward_m: float
    top_m: float
    cliff_m: float
    fence: tuple[float, ...]
    limits: Limits


class Memory(NamedTuple):
    """What was measured before.

    Args:
        changes: When each sensor last changed: its stamp and, of scans and depth images, its content.
        contents: Checksum of the last scan and depth image, and when it last was another.
        pose: Last pose of the odometry, and when it came.
        task: Last state of the task.
        task_since_s: Since when it has been running; None where it is not.
        commanded: Whether a command ever came.
    """

    changes: Mapping[str, Change] = {}
    contents: Mapping[str, tuple[int, float]] = {}
    pose: tuple[PlanarPose, float] | None = None
    task: str = ""
    task_since_s: float | None = None
    commanded: bool = False


def measure(snapshot: Snapshot, robot: Robot, memory: Memory) -> tuple[Facts, Memory]:
    """Return the facts of a step, and the memory after it."""
    changes = note_changes(snapshot, SENSORS, memory.changes)
    contents = _contents(snapshot, memory.contents)
    command = snapshot.message("cmd_vel", Twist)
    linear, angular = (command.linear.x, command.angular.z) if command is not None else (0.0, 0.0)
    finite = math.isfinite(linear) and math.isfinite(angular)
    passed_on = clamp(linear, robot.max_linear), clamp(angular, robot.max_angular)
    way = free_way.path(*passed_on) if finite else np.zeros((1, 2))
    out = {name for name in SENSORS if _age(snapshot, name, changes, contents) > robot.max_age_s}
    clear, cliff, gap = _look(snapshot, robot, way, out)
    if gap:
        out.add("scan")
    jump, pose = _jump(snapshot, robot, memory)
    illegal, task, since = _task(snapshot, memory)
    facts = Facts(
        clearance_m=clear,
        blind=len(way) > 1 and {"scan", "depth"} <= out,
        sensor_out=any(name in out for name in robot.expects),
        cliff=cliff,
        jump=jump,
        battery=_battery(snapshot),
        current_a=_current(snapshot),
        fence_m=_fence(snapshot, robot, pose, changes),
        task_s=snapshot.time_s - since if since is not None else 0.0,
        illegal=illegal,
        person=_is_true(snapshot, "person"),
        silence_s=snapshot.age_s("cmd_vel") if command is not None else 0.0,
        stop=_is_true(snapshot, "emergency_stop"),
        finite=finite,
    )
    return facts, Memory(changes, contents, pose, task, since, memory.commanded or command is not None)


def _contents(snapshot: Snapshot, known: Mapping[str, tuple[int, float]]) -> dict[str, tuple[int, float]]:
    """Return the checksum of scan and depth image, and when it last changed: noise is in each true measurement.

    One without a finite value, as in an empty field, says nothing.
    """
    contents = dict(known)
    for name in ("scan", "depth"):
        reading = snapshot.newest.get(name)
        if reading is None or (known and not snapshot.readings.get(name)):
            continue
        values = getattr(reading.message, "ranges" if name == "scan" else "data", np.zeros(0))
        empty = name == "scan" and not np.isfinite(values).any()
        digest = zlib.crc32(np.ascontiguousarray(values).tobytes())
        if empty or name not in contents or contents[name][0] != digest:
            contents[name] = (digest, reading.received_s)
    return contents


def _age(
    snapshot: Snapshot, name: str, changes: Mapping[str, Change], contents: Mapping[str, tuple[int, float]]
) -> float:
    """Return the age of a sensor in seconds: the larger of that of its message and that of its content."""
    return max(age_s(snapshot, name, changes), snapshot.time_s - contents[name][1] if name in contents else 0.0)


def _look(snapshot: Snapshot, robot: Robot, way: Array, out: set[str]) -> tuple[float, bool, bool]:
    """Return the clearance of a path in metres, whether there is a cliff, and whether the scan has a gap."""
    found, cliff, gap = [np.zeros((0, 2))], False, False
    radius = robot.radius_m + robot.margin_m
    scan = snapshot.message("scan", LaserScan)
    if scan is not None:
        angles, ranges = rays_of(scan)
        angles = angles + robot.scan_yaw
        found.append(free_way.of_scan(angles, ranges) + np.array([robot.scan_forward_m, 0.0]))
        gap = free_way.has_gap(angles, ranges, way)
    depth, size, _ = thin_depth_of(snapshot.message("depth", Image), free_way.STRIDE)
    if depth is not None and min(size) > free_way.STRIDE // 2:
        points = free_way.of_depth(depth, size, robot.mount)
        found.append(free_way.obstacles(points, robot.cliff_m, robot.top_m))
        cliff = free_way.is_cliff(points, way, robot.mount, radius, robot.cliff_m)
        if not np.isfinite(depth).any():
            out.add("depth")
    else:
        out.add("depth")
    return free_way.clearance(np.concatenate(found), way, radius), cliff, gap


def _jump(snapshot: Snapshot, robot: Robot, memory: Memory) -> tuple[bool, tuple[PlanarPose, float] | None]:
    """Return whether the pose changed by more than 1.5 times what the robot can do, and 0.1 m and 0.2 rad."""
    pose, reading = pose_of(snapshot.message("odometry", Odometry)), snapshot.newest.get("odometry")
    if pose is None or reading is None:
        return reading is not None, memory.pose
    if memory.pose is None or reading.received_s <= memory.pose[1]:
        return False, memory.pose or (pose, reading.received_s)
    last, seconds = memory.pose[0], reading.received_s - memory.pose[1]
    moved = math.hypot(pose.x - last.x, pose.y - last.y) > 1.5 * robot.max_linear * seconds + 0.1
    turned = abs(wrap(pose.yaw - last.yaw)) > 1.5 * robot.max_angular * seconds + 0.2
    return moved or turned, (pose, reading.received_s)


def _task(snapshot: Snapshot, memory: Memory) -> tuple[bool, str, float | None]:
    """Return whether the state of the task changed as it cannot, the state, and since when it has been running."""
    task, since, illegal = memory.task, memory.task_since_s, False
    for reading in snapshot.readings.get("task", ()):
        word = reading.message.data.split(" ")[0] if isinstance(reading.message, String) else ""
        illegal = illegal or word not in LEGAL or bool(task in LEGAL and word != task and word not in LEGAL[task])
        since = (snapshot.time_s if since is None else since) if word in ("running", "paused") else None
        task = word
    return illegal, task, since


def _battery(snapshot: Snapshot) -> float:
    battery = snapshot.message("battery", BatteryState)
    return battery.percentage if battery is not None else math.nan


def _current(snapshot: Snapshot) -> float:
    """Return the largest current that is known; NaN without one."""
    joints = snapshot.message("joints", JointState)
    if joints is None or not len(joints.effort):
        return math.nan
    return float(np.fmax.reduce(np.abs(joints.effort)))


def _fence(
    snapshot: Snapshot, robot: Robot, pose: tuple[PlanarPose, float] | None, changes: Mapping[str, Change]
) -> float:
    """Return the distance to the nearest side of the fence from inside, negative outside, in metres.

    It is that of the last pose, less the way that the robot can have gone since.
    """
    if pose is None or not robot.fence:
        return math.inf
    (x, y, _), came_s = pose
    left, low, right, high = robot.fence
    unknown_s = snapshot.time_s - min(came_s, changes["odometry"].time_s)
    return min(x - left, right - x, y - low, high - y) - robot.max_linear * unknown_s


def _is_true(snapshot: Snapshot, name: str) -> bool:
    """Whether the newest message is true, or any that came since the last step: a button may be pressed shortly."""
    read = [reading.message for reading in snapshot.readings.get(name, ())]
    return any(isinstance(message, Bool) and message.data for message in (*read, snapshot.message(name, Bool)))
