"""Drive the simulated TurtleBot 4 with each mobile controller, and count what went wrong.

    python tests/validation/robots/mobile.py steps --episodes 100
    python tests/validation/robots/mobile.py collisions --episodes 100 --bundle BUNDLE [--hostile] [--only vln]
    python tests/validation/robots/mobile.py vln --episodes 100 --bundle BUNDLE [--task GoToLocal]

``steps``: a target appears beside and before or behind its place; 3 s later heading and distance are judged, and 1 s
after it is gone, whether the robot stands. ``collisions``: a room with pillars, a cliff, moving things and people, the
safety monitor on, its emergencies released every two seconds; ``--hostile`` adds, in turns, things that step in 0.5 m
ahead, a frozen depth camera, lidar gaps, a delay of 300 ms, a policy (or target) of noise, and all of them. ``vln``:
the sample policy through continuous motion beside the same seeds in its discrete environment. BUNDLE is the int8
bundle of ``sample_models/vln-babyai``. Ends with 1 where a collision or a fall happened, a step failed, or success in
continuous motion is more than a point lower.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from _loop import Loop
from _vln_episodes import FIRST_SEED, RESTING, paired_episodes, rate_of

from vlatool.controllers._interface import Request
from vlatool.controllers.cloud_follower import CloudFollower
from vlatool.controllers.roi_follower import RoiFollower
from vlatool.controllers.roi_tracker import RoiTracker
from vlatool.controllers.safety_monitor import SafetyMonitor
from vlatool.controllers.vln import Vln
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import String
from vlatool.messages.std_srvs import SetBoolRequest
from vlatool.stats.intervals import paired_drop
from vlatool.worlds import open_world
from vlatool.worlds._turtlebot4_sensors import HFOV_RAD

FOLLOWERS = {"roi-tracker": RoiTracker, "roi-follower": RoiFollower, "cloud-follower": CloudFollower}
FRONT = {"roi-follower": 0.840, "cloud-follower": 0.785, "roi-tracker": 0.785}
"""How far the mean of what is seen of the target lies before its axis, in its radii: of the middle 90 % and of all."""
RADIUS = 0.12
SENSORS = "roi,info,depth,cloud,odom,scan,person,joints,battery"
HOSTILE = ("intruder", "frozen depth", "lidar gaps", "delay", "noise", "all")


def step_episode(name: str, seed: int) -> tuple[bool, bool, float]:
    """Return whether heading and distance are right after 3 s, whether it stands 1 s later, and the largest excess."""
    random = np.random.default_rng([seed, 7])
    world = open_world("turtlebot4", pillars=0, only="roi,info,depth,cloud")
    world.reset(seed)
    controller = FOLLOWERS[name]()
    goal = getattr(controller, "goal_z", 1.0)
    reach = 8.0 if name == "cloud-follower" else 25.0
    angle = world.truth()["pose"][2] + math.radians(random.uniform(-reach, reach))
    distance = goal + FRONT[name] * RADIUS + random.uniform(-0.2, 0.2)
    world.place_target(distance * math.cos(angle), distance * math.sin(angle))
    loop = Loop(world, [controller])
    loop.run(3.0)
    far, bearing = world.truth()["target"]
    heading = abs(math.tan(bearing) / math.tan(HFOV_RAD / 2.0))
    error = abs(far * math.cos(bearing) - FRONT[name] * RADIUS - goal) if name != "roi-tracker" else 0.0
    side = abs(far * math.sin(bearing))
    right = (side <= 0.06 if name == "cloud-follower" else heading <= 0.1125) and error <= 0.055
    world.hide_target()
    loop.run(1.0)
    linear, angular = world.truth()["velocity"]
    excess = max(heading - 0.1 if name != "cloud-follower" else side - 0.05, error - 0.05)
    return right, abs(linear) < RESTING and abs(angular) < RESTING, excess


class Noise:
    """A policy that chooses at random."""

    def __init__(self, policy: Any, seed: int) -> None:
        self.spec, self.random = policy.spec, np.random.default_rng(seed)

    def reset(self, seed: int | None = None) -> None:
        pass

    def infer(self, observation: Any) -> Any:
        return SimpleNamespace(chunk=np.array([self.random.integers(len(self.spec.action.labels))]))


def knobs_of(mode: str) -> dict[str, Any]:
    """Return the knobs of a hostile room."""
    every = mode == "all"
    knobs: dict[str, Any] = {}
    if mode == "intruder" or every:
        knobs["intruder_s"] = 3.0
    if mode == "lidar gaps" or every:
        knobs["gaps"] = 0.25
    if mode == "delay" or every:
        knobs["delay"] = "0.3"
    return knobs


def freezer(mode: str) -> Any:
    """Return what makes the depth camera send one image again and again from its 20th on, with new stamps."""
    sent: list[Image] = []

    def alter(topic: str, message: Any) -> Any:
        if topic != "/camera/depth/image_raw" or mode not in ("frozen depth", "all"):
            return message
        sent.append(message)
        return message if len(sent) < 20 else Image(message.header, *(getattr(sent[19], f) for f in FIELDS))

    return alter


FIELDS = ("height", "width", "encoding", "is_bigendian", "step", "data")


def collision_episode(name: str, seed: int, hostile: bool, policy: Any, seconds: float = 10.0) -> dict[str, float]:
    """Return collisions, falls, metres driven and emergencies of an episode."""
    mode = HOSTILE[seed % len(HOSTILE)] if hostile else ""
    vln = name == "vln"
    size = {"width": 56, "height": 56} if vln else {}
    world = open_world(
        "turtlebot4", pillars=6, cliffs=1, movers=2, people=1, command_topic="/safe_cmd_vel",
        only=SENSORS + (",color" if vln else ""), **size, **knobs_of(mode),
    )  # fmt: skip
    world.reset(seed)
    random = np.random.default_rng([seed, 8])
    if vln:
        chooser = Noise(policy, seed) if mode in ("noise", "all") else policy
        controller: Any = Vln(policy=chooser, forward_m=0.5, clearance_m=0.35)
    else:
        controller = FOLLOWERS[name]()
    monitor = SafetyMonitor()
    loop = Loop(world, [controller, monitor], freezer(mode))
    loop.publish("/vln/instruction", String("go to the red ball"))
    lead, driven, emergencies = Lead(random, mode in ("noise", "all")), 0.0, 0
    for tick in range(round(seconds / 0.1)):
        if not vln:
            world.place_target(*lead.place(world.truth()["pose"]))
        before = world.truth()["pose"]
        loop.run(0.1)
        after = world.truth()["pose"]
        driven += math.hypot(after[0] - before[0], after[1] - before[1])
        node = loop.nodes[1]
        if node.command.status.startswith("EMERGENCY") and tick % 20 == 0:
            emergencies += 1
            node.requests.append(Request("emergency", SetBoolRequest(False), tick))
    truth = world.truth()
    return {
        "collisions": truth["collisions"],
        "falls": int(truth["fell"]),
        "metres": driven,
        "emergencies": emergencies,
    }


class Lead:
    """A target that walks ahead of the robot at 0.2 m/s and turns at random; or one that is anywhere at any time."""

    def __init__(self, random: np.random.Generator, noise: bool) -> None:
        self.random, self.noise, self.at, self.yaw = random, noise, None, 0.0

    def place(self, pose: Any) -> tuple[float, float]:
        x, y, yaw = pose
        if self.at is None or self.noise or math.hypot(self.at[0] - x, self.at[1] - y) > 1.5:
            angle, far = yaw + self.random.uniform(-0.4, 0.4), self.random.uniform(0.6, 1.3)
            self.at, self.yaw = (x + far * math.cos(angle), y + far * math.sin(angle)), angle
        self.yaw += self.random.normal(0.0, 0.1)
        self.at = (self.at[0] + 0.02 * math.cos(self.yaw), self.at[1] + 0.02 * math.sin(self.yaw))
        return self.at


def vln_trial(task: str, seeds: range, policy: Any, file: Path | None) -> int:
    """Print how discrete and continuous episodes of the same seeds ended; return 1 where success is a point lower."""
    started = time.process_time()
    pairs = paired_episodes(task, [FIRST_SEED + seed for seed in seeds], policy, file)
    discrete, continuous = map(list, zip(*pairs, strict=True))
    lost = sum(one.success and not other.success for one, other in pairs)
    won = sum(other.success and not one.success for one, other in pairs)
    drop, low, high = (100 * share for share in paired_drop(lost, won, len(pairs)))
    same = sum(one.actions == other.actions for one, other in pairs)
    seconds = sum(end.seconds for end in continuous) / len(pairs)
    print(f"vln {task}, seeds {discrete[0].seed} to {discrete[-1].seed}, {time.process_time() - started:.0f} CPU-s")
    print(f"  success in continuous motion: {rate_of(continuous)}")
    print(f"  in the discrete environment:  {rate_of(discrete)}")
    print(f"  {lost} lost, {won} won: {drop:.1f} points lower ({low:.1f} to {high:.1f}); the same actions in {same}; "
          f"stopped by itself in {sum(end.stopped for end in continuous)}, "
          f"{sum(end.collisions for end in continuous)} collisions, {seconds:.1f} s each", flush=True)  # fmt: skip
    for one, other in pairs:
        if one.success != other.success or not other.stopped:
            print(f"  {one}\n  {other}")
    return int(drop > 1.0 or not all(end.stopped for end in continuous if end.success))


def report(title: str, rows: list[dict[str, Any]], started: float) -> None:
    """Print the sums of the columns of episodes."""
    sums = {key: round(float(sum(row[key] for row in rows)), 1) for key in rows[0]}
    print(f"{title}: {len(rows)} episodes, {sums}, {time.process_time() - started:.0f} CPU-s", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("steps", "collisions", "vln"))
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--bundle", type=Path)
    parser.add_argument("--task", default="GoToLocalS6N3")
    parser.add_argument("--lines", type=Path, help="vln: JSON lines of the episodes, to go on after an interruption")
    parser.add_argument("--hostile", action="store_true")
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.episodes)
    policy, bad = None, 0
    if options.bundle is not None:
        from vlatool import load

        policy = load(options.bundle, threads=1)
    if options.what == "vln":
        return vln_trial(options.task, seeds, policy, options.lines)
    names = [*FOLLOWERS] if options.what == "steps" else [*FOLLOWERS, "vln"]
    for name in (name for name in names if options.only in ("", name)):
        started = time.process_time()
        if options.what == "steps":
            found = [step_episode(name, seed) for seed in seeds]
            rows = [{"right": right, "at rest": rest} for right, rest, _ in found]
            bad += sum(not (right and rest) for right, rest, _ in found)
            report(f"{name}, largest excess {max(excess for *_, excess in found):.4f}", rows, started)
        else:
            rows = [collision_episode(name, seed, options.hostile, policy) for seed in seeds]
            bad += int(sum(row["collisions"] + row["falls"] for row in rows))
            report(f"{name}{', hostile' if options.hostile else ''}", rows, started)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
