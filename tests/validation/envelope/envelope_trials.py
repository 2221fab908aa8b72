"""Attack the envelope of each robot, or send it legal motions, and judge what it sent with code of its own.

    python tests/validation/envelope/envelope_trials.py --steps 100000 [--robots ur5e fr3] [--seed 7]
    python tests/validation/envelope/envelope_trials.py --legal --steps 100000
    python tests/validation/envelope/envelope_trials.py --ruckig --share 0.99 --steps 10000 --robots ur5e
    python tests/validation/envelope/envelope_trials.py --cost

Prints a line for each robot and mode of control: steps, the largest excess of position, velocity, acceleration and jerk
in the units of the limits, and how many steps passed unchanged. Ends with 1 if an excess is above 1e-9 or, of legal
motions, if a step is changed. ``tests/_envelope_judge.py`` says how differences are taken and ``_envelope_attacks.py``
what the commands are. Legal motions are sums of sines within a share of every limit, from rest to rest; with
``--ruckig``, the time-optimal motions of Ruckig at a share of the limits, to random targets of which every third is on
the limits.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from _envelope_attacks import Robot, attack  # noqa: E402
from _envelope_judge import over_curve  # noqa: E402

from vlatool.runtime.envelope import Box, Envelope, RobotLimits, robot_names  # noqa: E402

PERIODS = {"turtlebot-4": 0.05, "fetch": 0.05, "px4-quadrotor": 0.05, "fr3": 0.01}
"""Robot -> period of its commands in s; 0.02 s otherwise."""
EPISODE = 1000
"""Steps from one start."""
PROMISE = 1e-9
LEGAL_SHARE = 0.9
"""Share of the limits that legal motions reach."""


def limits_of(name: str) -> RobotLimits:
    """Return the limits of a robot; Cartesian ones with a workspace, and a box in it to keep out of."""
    limits = RobotLimits.named(name)
    if limits.space != "cartesian":
        return limits
    size = 20.0 if name.startswith("px4") else 0.5
    axes = ("x", "y", "z")
    workspace = Box(dict.fromkeys(axes, -size), dict.fromkeys(axes, size))
    corner = Box(dict.fromkeys(axes, 0.8 * size), dict.fromkeys(axes, 0.9 * size))
    return limits.within(workspace).outside(corner)


def cases(names: list[str]) -> Iterator[tuple[str, str]]:
    """Yield each robot with the modes that differ for it; deltas are absolute positions less the last one."""
    for name in names:
        modes = {joint.command or "any" for joint in RobotLimits.named(name).joints}
        yield from ((name, mode) for mode in (("absolute", "delta", "velocity") if "any" in modes else ("velocity",)))


def attacked(name: str, mode: str, steps: int, seed: int) -> tuple[Robot, dict[str, float]]:
    """Attack a robot from many starts; return it, and its largest excesses."""
    robot, random = Robot(limits_of(name), PERIODS.get(name, 0.02), mode), np.random.default_rng(seed)
    worst = dict.fromkeys(("position", "velocity", "acceleration", "jerk"), -math.inf)
    while robot.steps < steps:
        found = attack(robot, min(EPISODE, steps - robot.steps), random)
        worst = {key: max(worst[key], value) for key, value in found.items()}
    return robot, worst


def motion(robot: Robot, steps: int, random: np.random.Generator, share: float) -> list[list[float]]:
    """Return positions of all joints in a motion from rest to rest, within a share of the limits."""
    times = robot.period * np.arange(1, steps + 1)
    columns = []
    for joint, low, high in zip(robot.joints, robot.low, robot.high, strict=True):
        if joint.command == "range":
            columns.append(np.full(steps, (low + high) / 2))
            continue
        rates = random.uniform(0.3, 3, 4)
        shape = sum(np.sin(rate * times + phase) for rate, phase in zip(rates, random.uniform(0, 6, 4), strict=True))
        ramp = np.clip(np.minimum(times, times[-1] - times) / 2, 0, 1)
        wave = shape * ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
        most = [np.abs(wave).max() / (0.4 * (high - low)), *(
            np.abs(np.diff(wave, order)).max() / robot.period**order / limit for order, limit in
            ((1, min(-joint.velocity[0], joint.velocity[1])), (2, joint.acceleration), (3, joint.jerk))
        )]  # fmt: skip
        columns.append((low + high) / 2 + wave * share / max(most))
        while (
            joint.curve is not None
            and over_curve(joint.curve, columns[-1], np.diff(columns[-1]) / robot.period / share) > 0
        ):
            columns[-1] = (low + high) / 2 + 0.9 * (columns[-1] - (low + high) / 2)
    positions: list[list[float]] = np.column_stack(columns).tolist()
    return positions


def legal(name: str, mode: str, steps: int, seed: int, share: float = LEGAL_SHARE) -> tuple[int, int]:
    """Send legal motions; return the number of steps, and of those that passed bit for bit."""
    random, passed, done = np.random.default_rng(seed), 0, 0
    while done < steps:
        robot = Robot(RobotLimits.named(name), PERIODS.get(name, 0.02), mode)
        path = motion(robot, min(EPISODE, steps - done), random, share)
        robot.start = [(low + high) / 2 for low, high in zip(robot.low, robot.high, strict=True)]
        robot.envelope.start(robot.start)
        last = robot.start
        for position in path:
            columns = zip(position, last, robot.velocities, robot.deltas, strict=True)
            command = [
                (value - before) / robot.period if rate else value - before if delta else value
                for value, before, rate, delta in columns
            ]
            result = robot.envelope.step(command, elapsed_s=robot.period)
            passed += result.command == tuple(command) and not result.checks
            last = position
        done += len(path)
    return done, passed


def optimal(name: str, steps: int, seed: int, share: float) -> tuple[int, int, float]:
    """Send motions of Ruckig; return the number of steps, of those that passed, and the largest change."""
    import ruckig

    random, passed, done, change = np.random.default_rng(seed), 0, 0, 0.0
    moving = [joint.name for joint in RobotLimits.named(name).joints if joint.command == ""]
    robot = Robot(RobotLimits.named(name).in_order(moving), PERIODS.get(name, 0.02), "absolute")
    low, high = np.array(robot.low), np.array(robot.high)
    at, count = (low + high) / 2, len(moving)
    while done < steps:
        target = random.uniform(low, high)
        if random.random() < 1 / 3:
            target = np.where(random.random(count) < 0.5, low, high)
        wanted, trajectory = ruckig.InputParameter(count), ruckig.Trajectory(count)
        wanted.synchronization = ruckig.Synchronization.No
        wanted.current_position, wanted.target_position = at.tolist(), target.tolist()
        wanted.max_velocity = [share * min(-joint.velocity[0], joint.velocity[1]) for joint in robot.joints]
        wanted.max_acceleration = [share * joint.acceleration for joint in robot.joints]
        wanted.max_jerk = [share * joint.jerk for joint in robot.joints]
        if ruckig.Ruckig(count).calculate(wanted, trajectory) != ruckig.Result.Working:
            raise RuntimeError("Ruckig finds no motion")
        envelope = Envelope(robot.limits, robot.period)
        envelope.start(at.tolist())
        for index in range(1, int(trajectory.duration / robot.period) + 3):
            position = trajectory.at_time(min(index * robot.period, trajectory.duration))[0]
            result = envelope.step(position, elapsed_s=robot.period)
            passed += not result.checks
            change = max(change, *(abs(new - old) for new, old in zip(result.command, position, strict=True)))
            done += 1
        at = target
    return done, passed, change


def cost(name: str = "franka-panda", steps: int = 20_000) -> tuple[float, float]:
    """Return the median and the 99th percentile of a step of a moving arm, in microseconds."""
    robot = Robot(RobotLimits.named(name), 0.02, "absolute")
    path = motion(robot, steps, np.random.default_rng(0), 0.5)
    envelope = Envelope(robot.limits, robot.period)
    envelope.start([(low + high) / 2 for low, high in zip(robot.low, robot.high, strict=True)])
    durations = []
    for command in map(np.array, path):
        begin = time.perf_counter_ns()
        envelope.step(command, elapsed_s=0.02)
        durations.append((time.perf_counter_ns() - begin) / 1e3)
    return statistics.median(durations), sorted(durations)[int(0.99 * steps)]


def main() -> int:
    """Run what was asked for, and print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000, help="of each robot and mode")
    parser.add_argument("--robots", nargs="+", default=robot_names())
    parser.add_argument("--modes", nargs="+", default=["absolute", "delta", "velocity"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=LEGAL_SHARE, help="of the limits that legal motions reach")
    parser.add_argument("--legal", action="store_true", help="send legal motions")
    parser.add_argument("--ruckig", action="store_true", help="send motions of Ruckig (pip install ruckig)")
    parser.add_argument("--cost", action="store_true", help="measure the time of a step of seven joints")
    given = parser.parse_args()
    if given.cost:
        print("a step of seven joints takes {:.1f} us (p50), {:.1f} us (p99)".format(*cost()))
        return 0
    failed = 0
    for name, mode in cases(given.robots):
        if mode not in given.modes:
            continue
        if given.ruckig:
            if mode == "absolute":
                done, passed, change = optimal(name, given.steps, given.seed, given.share)
                print(
                    f"{name:18} {done:9} steps, {passed / done:.2%} unchanged, largest change {change:.2g}", flush=True
                )
        elif given.legal:
            done, passed = legal(name, mode, given.steps, given.seed, given.share)
            print(f"{name:18} {mode:9} {done:9} steps, {passed} unchanged", flush=True)
            failed += passed < done
        else:
            robot, worst = attacked(name, mode, given.steps, given.seed)
            excesses = " ".join(f"{key} {value:9.2g}" for key, value in worst.items())
            share = robot.checks["none"] / robot.steps
            print(f"{name:18} {mode:9} {robot.steps:9} steps, excess {excesses}, {share:.0%} unchanged", flush=True)
            failed += max(worst.values()) > PROMISE
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
