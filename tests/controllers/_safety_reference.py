"""A second model of the safety monitor, written from its documentation in plain loops, and random events for both.

An event is a dict of what came at a step, as numbers and arrays, not as messages. ``to_messages`` makes messages of it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from _mobile_feed import depth_image, header, odometry, velocity

from vlatool.messages.sensor_msgs import BatteryState, JointState, LaserScan
from vlatool.messages.std_msgs import Bool, String

RAYS, ROWS, COLUMNS = 36, 24, 32
AHEAD = RAYS // 4
"""Ray that points where the robot goes: the lidar of a TurtleBot 4 is turned by 90 degrees to the left."""
FENCE = (-3.0, -3.0, 3.0, 3.0)
HFOV, TASK_S = math.radians(69.0), 3.0
FOLLOWS = {
    "idle": ["running"], "running": ["idle", "paused", "arrived", "failed"], "paused": ["idle", "running", "failed"],
    "arrived": ["idle", "running"], "failed": ["idle", "running"],
}  # fmt: skip


class Reference:
    """Levels 0 to 3 and what is sent, from events."""

    def __init__(self) -> None:
        self.level, self.clear = 0, None
        self.last: dict[str, Any] = {}
        self.came: dict[str, float] = {}
        self.stamp: dict[str, tuple[float, float]] = {}
        self.content: dict[str, tuple[Any, float]] = {}
        self.pose: Any = None
        self.task, self.since = "", None

    def step(self, time: float, event: dict[str, Any]) -> tuple[int, float, float, list[bool]]:
        demand = self.demand(time, event)
        if demand >= self.level:
            self.level, self.clear = demand, None
        elif self.level < 3:
            if self.clear is None:
                self.clear = time
            elif time - self.clear >= 1.0:
                self.level, self.clear = self.level - 1, time
        answers = []
        for wanted in event.get("calls", []):
            if wanted:
                self.level, self.clear = 3, None
                answers.append(True)
            else:
                if self.level == 3 and demand < 3:
                    self.level, self.clear = 2, time
                answers.append(self.level < 3)
        linear, angular = self.last.get("command", (0.0, 0.0))
        usable = (
            "command" in self.last and time - self.came["command"] <= 0.5 and self.level < 3
            and all(name in self.last for name in ("scan", "depth", "odometry"))
            and math.isfinite(linear) and math.isfinite(angular)
        )  # fmt: skip
        if not usable:
            return self.level, 0.0, 0.0, answers
        scale = (1.0, 0.5, 0.2)[self.level]
        linear, angular = self.within(linear, angular)
        return self.level, scale * linear, scale * angular, answers

    @staticmethod
    def within(linear: float, angular: float) -> tuple[float, float]:
        """Speeds that are passed on at most: those of the way that is looked at, too."""
        return min(max(linear, -0.306), 0.306), min(max(angular, -1.9), 1.9)

    def demand(self, time: float, event: dict[str, Any]) -> int:
        for name, value in event.items():
            if name not in ("calls", "stamp"):
                self.last[name], self.came[name] = value, time
        asked = [0]
        linear, angular = self.last.get("command", (0.0, 0.0))
        finite = math.isfinite(linear) and math.isfinite(angular)
        way = self.way(*self.within(linear, angular)) if finite else []
        out = self.out(time, event)
        gap, near, cliff = self.look(way, event)
        if gap:
            out.add("scan")
        if "depth" in self.last and not np.isfinite(self.last["depth"]).any():
            out.add("depth")
        asked += [1] if near <= 0.6 else []
        asked += [2] if near <= 0.4 else []
        asked += [3] if near <= 0.25 else []
        asked += [2] if out else []
        asked += [3] if way and "scan" in out and "depth" in out else []
        asked += [3] if cliff else []
        asked += [2] if self.jumped(time, event) else []
        for limit, level in ((0.2, 1), (0.1, 2), (0.05, 3)):
            asked += [level] if self.last.get("battery", 1.0) < limit else []
        amperes = max((abs(value) for value in self.last.get("current", []) if not math.isnan(value)), default=0.0)
        asked += [2] if amperes > 3.0 else []
        asked += [3] if amperes > 6.0 else []
        if self.pose is not None:
            x, y = self.pose[0][:2]
            unknown_s = time - min(self.pose[1], self.stamp["odometry"][1])
            inside = min(x - FENCE[0], FENCE[2] - x, y - FENCE[1], FENCE[3] - y) - 0.306 * unknown_s
            asked += [1] if inside < 0.3 else []
            asked += [3] if inside < 0.0 else []
        asked += [2] if self.tasked(time, event) else []
        asked += [2] if self.since is not None and time - self.since > TASK_S else []
        asked += [2] if self.last.get("person") else []
        asked += [1] if "command" in self.last and time - self.came["command"] > 1.0 else []
        asked += [2] if not finite else []
        asked += [3] if self.last.get("stop") else []
        return max(asked)

    def way(self, linear: float, angular: float) -> list[tuple[float, float]]:
        """Places of the centre, 5 cm apart, up to a metre."""
        if abs(linear) < 1e-3:
            return []
        places, sign = [], 1.0 if linear > 0 else -1.0
        for count in range(1, 21):
            length, bend = 0.05 * count, angular / abs(linear)
            angle = bend * length
            if abs(angle) > 1e-6:
                x, y = math.sin(angle) / bend, (1 - math.cos(angle)) / bend
            else:
                x, y = length, 0.0
            places.append((sign * x, sign * y))
        return places

    def out(self, time: float, event: dict[str, Any]) -> set[str]:
        """Sensors that are older than 0.6 s: never came, stamp as before, stamp old, or the same content."""
        out = set()
        for name in ("scan", "depth", "odometry"):
            if name not in self.last:
                out.add(name)
                continue
            if name in event and (name not in self.stamp or self.stamp[name][0] != event["stamp"][name]):
                self.stamp[name] = (event["stamp"][name], time)
            stamp, changed = self.stamp[name]
            age = time - changed
            if 0.0 < time - stamp < 10.0:
                age = max(age, time - stamp)
            if name != "odometry":
                value = self.last[name]
                empty = name == "scan" and not np.isfinite(value).any()
                same = name in self.content and np.array_equal(value, self.content[name][0], equal_nan=True)
                if name in event and (empty or not same):
                    self.content[name] = (value, time)
                age = max(age, time - self.content[name][1])
            if age > 0.6:
                out.add(name)
        return out

    def look(self, way: list[tuple[float, float]], event: dict[str, Any]) -> tuple[bool, float, bool]:
        del event
        points, low, gap = [], [], False
        if "scan" in self.last:
            unknown = rays = 0
            ahead = math.atan2(way[4][1], way[4][0]) if way else 0.0
            for index, value in enumerate(self.last["scan"].tolist()):
                angle = -math.pi / 2 + index * 2 * math.pi / RAYS  # the lidar is turned to the left, 4 cm behind
                if way and abs(math.remainder(angle - ahead, 2 * math.pi)) < math.radians(20):
                    rays, unknown = rays + 1, unknown + math.isnan(value)
                if math.isfinite(value):
                    points.append((value * math.cos(angle) - 0.04, value * math.sin(angle)))
            gap = bool(way) and (rays < 3 or unknown / rays > 0.1)
        focal = COLUMNS / (2 * math.tan(HFOV / 2))
        for row in range(2, ROWS, 4):
            for column in range(2, COLUMNS, 4):
                z = float(self.last["depth"][row, column]) if "depth" in self.last else math.nan
                if not math.isfinite(z) or z <= 0:
                    continue
                side, height = -z * (column + 0.5 - COLUMNS / 2) / focal, 0.244 - z * (row + 0.5 - ROWS / 2) / focal
                if 0.06 < height < 0.6:
                    points.append((z, side))
                if height < -0.06:
                    share = 0.244 / (0.244 - height)
                    low.append((z * share, side * share))
        near = math.inf
        points = [(px, py) for px, py in points if math.hypot(px, py) < 1.3]
        for count, (x, y) in enumerate(way):
            apart = [(math.hypot(px - x, py - y), math.hypot(px, py)) for px, py in points]
            if any(now < 0.21 and now < before for now, before in apart):
                near = count * 0.05
                break
        holes = sum(any(math.hypot(px - x, py - y) < 0.21 for x, y in way) for px, py in low)
        return gap, near, bool(way) and way[0][0] > 0 and holes >= 3

    def jumped(self, time: float, event: dict[str, Any]) -> bool:
        if "odometry" not in event:
            return "odometry" in self.last and not all(math.isfinite(v) for v in self.last["odometry"])
        new = event["odometry"]
        if not all(math.isfinite(v) for v in new):
            return True
        old, self.pose = self.pose, (new, time)
        if old is None:
            return False
        (x, y, yaw), then = old
        turn = abs(math.remainder(new[2] - yaw, 2 * math.pi))
        seconds = time - then
        return math.hypot(new[0] - x, new[1] - y) > 1.5 * 0.306 * seconds + 0.1 or turn > 1.5 * 1.9 * seconds + 0.2

    def tasked(self, time: float, event: dict[str, Any]) -> bool:
        if "task" not in event:
            return False
        word = event["task"].split()[0]
        bad = word not in FOLLOWS or (self.task in FOLLOWS and word != self.task and word not in FOLLOWS[self.task])
        if word not in ("running", "paused"):
            self.since = None
        elif self.since is None:
            self.since = time
        self.task = word
        return bad


class Events:
    """Random events; ``quiet`` ones first, so that each condition also comes alone."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.time, self.pose = 0.0, [2.5, 0.0, 0.0]
        self.trouble, self.until = "", 0.0
        self.kept: dict[str, Any] = {}
        self.task, self.order, self.since = "idle", [], 0.0

    MILD = ("obstacle far", "low", "fence", "silent")
    """Troubles that are a WARNING at most, which a level that still falls would hide."""

    KINDS = (
        "obstacle far", "obstacle near", "obstacle close", "scan late", "depth late", "odometry late", "scan frozen",
        "depth frozen", "both late", "gap", "nan depth", "cliff", "jump", "nan pose", "low", "very low", "empty",
        "current", "high current", "fence", "outside", "long task", "illegal", "unknown task", "person", "silent",
        "nan command", "stop", "old stamp", "call",
    )  # fmt: skip

    def next(self) -> tuple[float, dict[str, Any]]:
        random = self.random
        self.time += (0.05, 0.05, 0.1, 0.3)[int(random.integers(4))] * float(random.uniform(0.97, 1.03))
        if self.time >= self.until:
            if not self.order:
                self.order = [self.KINDS[place] for place in random.permutation(len(self.KINDS))]
            calm = self.trouble == "" and self.until - self.since > 3.0
            self.trouble, self.since = self.order[-1] if calm or random.random() < 0.7 else "", self.time
            self.until = self.time + float(random.uniform(0.2, 2.0))
            if self.trouble in self.MILD and not calm:  # only what comes after a calm time is seen
                self.trouble, self.until = "", self.time + 3.2
            elif self.trouble:
                self.order.pop()
            if self.trouble == "long task":
                self.until = self.time + TASK_S + 1.0
        t, event = self.trouble, {"stamp": {}}
        self.command(t, event)
        self.ranges(t, event)
        self.where(t, event)
        self.rest(t, event)
        return self.time, event

    def command(self, t: str, event: dict[str, Any]) -> None:
        random = self.random
        if t != "silent" and random.random() < 0.8:
            linear = (0.3, 0.3, 0.2, -0.2, 0.0, 0.5)[int(random.integers(6))]
            event["command"] = (linear, float(random.normal(0, 0.5)) if random.random() < 0.5 else 0.0)
            if t == "nan command":
                event["command"] = (math.nan, 0.0) if random.random() < 0.5 else (0.1, math.inf)

    def ranges(self, t: str, event: dict[str, Any]) -> None:
        random = self.random
        if t not in ("scan late", "both late") or not self.kept:
            scan = random.uniform(3, 3.1, RAYS)
            if t.startswith("obstacle") and random.random() < 0.7:
                low, high = {"far": (0.7, 0.8), "near": (0.5, 0.62), "close": (0.15, 0.45)}[t.split()[1]]
                scan[random.integers(AHEAD - 1, AHEAD + 2)] = random.uniform(low, high)
                behind = random.uniform(low, high) if random.random() < 0.3 else 3.0
                scan[AHEAD + RAYS // 2 + random.integers(0, 2)] = behind
            if t == "gap":
                scan[AHEAD - 2 : AHEAD + 3] = math.nan
            if random.random() < 0.01:
                scan[:] = math.inf
            self.put("scan", scan.astype(np.float32), t == "scan frozen", t, event)
        if t not in ("depth late", "both late") or not self.kept:
            depth = self.floor(0.6 if t == "cliff" else 0.0) * random.normal(1, 0.005, (ROWS, COLUMNS))
            if t.startswith("obstacle"):
                wall = {"far": 0.8, "near": 0.55, "close": 0.35}[t.split()[1]] * random.uniform(0.9, 1.1)
                depth = np.minimum(depth, wall) if random.random() < 0.5 else depth
            if t == "nan depth":
                depth[:] = math.nan
            self.put("depth", depth.astype(np.float32), t == "depth frozen", t, event)

    def put(self, name: str, value: Any, same: bool, t: str, event: dict[str, Any]) -> None:
        """Send a value, the one before, or the one before with its stamp."""
        if same and name in self.kept:
            value = self.kept[name][0]
        stamp = self.kept[name][1] if t == "old stamp" and name in self.kept else self.time
        self.kept[name] = (value, stamp)
        event[name], event["stamp"][name] = value, stamp

    def floor(self, deeper: float) -> np.ndarray:
        """Depth of a floor 0.244 m below the camera, or deeper, and of a far wall."""
        focal = COLUMNS / (2 * math.tan(HFOV / 2))
        down = (np.arange(ROWS) + 0.5 - ROWS / 2) / focal
        metres = np.where(down > 0, (0.244 + deeper) / np.maximum(down, 1e-9), 4.0)
        return np.minimum(metres, 4.0)[:, None].repeat(COLUMNS, 1)

    def where(self, t: str, event: dict[str, Any]) -> None:
        random = self.random
        if t in ("odometry late", "both late") and self.random.random() < 0.99 and "odometry" in self.kept:
            return
        x = self.pose[0]
        if t == "jump" and random.random() < 0.3:
            self.pose = [random.uniform(-2, 2), 0.0, random.uniform(-3, 3)]
        elif t in ("fence", "outside"):
            self.pose[0] += 0.1 if x < (2.85 if t == "fence" else 3.2) else 0.0
        elif t != "jump" and not 2.3 < x < 2.65:
            self.pose = [x - 0.1 if x > 2.6 else 2.5, 0.0, 0.0]
        pose = [float(v) for v in self.pose]
        value = (math.nan, 0.0, 0.0) if t == "nan pose" else tuple(pose)
        self.put("odometry", value, False, t, event)

    def rest(self, t: str, event: dict[str, Any]) -> None:
        random = self.random
        charge = {"low": (0.1, 0.2), "very low": (0.05, 0.1), "empty": (0.0, 0.05)}.get(t, (0.2, 1.0))
        event["battery"] = float(np.float32(random.uniform(*charge)))
        ampere = {"current": 4.0, "high current": 7.0}.get(t, 1.0)
        event["current"] = [float(-ampere * random.uniform(0.9, 1.1)), 0.5, math.nan if random.random() < 0.5 else 0.2]
        event["person"], event["stop"] = t == "person", t == "stop"
        if random.random() < 0.2 and t != "long task":
            self.task = str(random.choice(FOLLOWS[self.task])) if self.task in FOLLOWS else "idle"
            event["task"] = f"{self.task} and more"
        if t == "long task" and self.task not in ("running", "paused"):
            self.task = event["task"] = "running" if self.task in FOLLOWS else "idle"
        if t in ("illegal", "unknown task") and random.random() < 0.3:
            wrong = [word for word in FOLLOWS if word != self.task and word not in FOLLOWS.get(self.task, [])]
            self.task = event["task"] = "flying" if t == "unknown task" or not wrong else str(random.choice(wrong))
        if random.random() < (0.6 if t == "call" else 0.2):
            event["calls"] = [bool(random.random() < 0.05)]


def to_messages(event: dict[str, Any]) -> dict[str, Any]:
    """Return the messages of an event: name of the input -> message."""
    made: dict[str, Any] = {}
    stamp = event["stamp"]
    if "command" in event:
        made["cmd_vel"] = velocity(*event["command"])
    if "scan" in event:
        step = 2 * math.pi / RAYS
        ranges = event["scan"]
        made["scan"] = LaserScan(header(stamp["scan"]), -math.pi, math.pi, step, 0.0, 0.1, 0.1, 12.0, ranges)
    if "depth" in event:
        made["depth"] = depth_image(event["depth"], stamp["depth"])
    if "odometry" in event:
        made["odometry"] = odometry(*event["odometry"], stamp_s=stamp["odometry"])
    if "battery" in event:
        made["battery"] = BatteryState(percentage=event["battery"])
    if "current" in event:
        made["joints"] = JointState(effort=np.array(event["current"]))
    if "task" in event:
        made["task"] = String(event["task"])
    for name, place in (("person", "person"), ("stop", "emergency_stop")):
        if name in event:
            made[place] = Bool(event[name])
    return made
