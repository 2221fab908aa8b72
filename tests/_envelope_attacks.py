"""Random and adversarial commands against an envelope, in segments of one kind, and what the judge says of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from _envelope_judge import excesses

from vlatool.errors import DataError, UsageError
from vlatool.runtime.envelope import Envelope, RobotLimits

WRONG: tuple[Any, ...] = (
    [], [0.0], "up", 3, {"a": 1}, np.zeros((2, 2)), np.array(["a"]), np.zeros(99), [None], object(), True,
)  # fmt: skip
LONGEST_STOP = 500
"""Periods in which every robot stops."""
BAD_NUMBERS = (math.nan, math.inf, -math.inf)


class Robot:
    """An envelope with the log of what it sent, as absolute values."""

    def __init__(
        self, limits: RobotLimits, period: float, mode: str, make: Callable[..., Envelope] = Envelope, **options: Any
    ) -> None:
        self.limits, self.period, self.mode, self.joints = limits, period, mode, limits.joints
        self.envelope = make(limits, period, mode=mode, **options)
        self.velocities = [joint.command != "range" and "velocity" in (joint.command, mode) for joint in self.joints]
        self.deltas = [mode == "delta" and joint.command == "" for joint in self.joints]
        self.low = [joint.low if joint.low is not None else -20.0 for joint in self.joints]
        self.high = [joint.high if joint.high is not None else 20.0 for joint in self.joints]
        bounded = any(rate and joint.low is not None for rate, joint in zip(self.velocities, self.joints, strict=True))
        self.gap = 4 if bounded else 7
        """Longest interval in periods; the positions of velocities are promised up to four."""
        self.checks: Counter[str] = Counter()
        self.steps = 0

    def begin(self, random: np.random.Generator) -> None:
        """Start somewhere within the limits, now and then on one of them; elsewhere is refused."""
        self.start = self._within_limits(random)
        while self._kept_out():
            refused(DataError, lambda: self.envelope.start(self.start))
            self.start = self._within_limits(random)
        for index, joint in enumerate(self.joints):
            if joint.low is not None:
                outside = [*self.start[:index], self.high[index] + 1e-3, *self.start[index + 1 :]]
                refused(DataError, lambda bad=outside: self.envelope.start(bad))
        self.envelope.start(self.start)
        self.absolute = [0.0 if rate else at for at, rate in zip(self.start, self.velocities, strict=True)]
        self.times: list[float] = []
        self.sent: list[tuple[float, ...]] = []
        self.now = 0.0

    def _within_limits(self, random: np.random.Generator) -> list[float]:
        share = random.choice([0.0, 1.0, 0.5, random.random()], size=len(self.low))
        return [low + part * (high - low) for low, high, part in zip(self.low, self.high, share, strict=True)]

    def _kept_out(self) -> bool:
        """Return whether the start is in a box to keep out of."""
        at = {joint.name: value for joint, value in zip(self.joints, self.start, strict=True)}
        return any(all(box.low[name] < at[name] < box.high[name] for name in box.low) for box in self.limits.keep_out)

    def step(self, command: Any, interval: float, **more: Any) -> None:
        """Take a step, and log what was sent."""
        result = self.envelope.step(command, elapsed_s=interval, **more)
        self.now += interval
        columns = zip(self.absolute, result.command, self.deltas, strict=True)
        self.absolute = [at + value if delta else value for at, value, delta in columns]
        self.times.append(self.now)
        self.sent.append(tuple(self.absolute))
        self.checks.update(result.checks or ("none",))
        self.steps += 1

    def judge(self) -> dict[str, float]:
        """Return the largest excesses since the start."""
        return excesses(self.limits, self.velocities, self.start, self.times, self.sent, self.period)

    def command(self, wanted: Sequence[float]) -> list[float]:
        """Return absolute values in the mode of the action."""
        columns = zip(wanted, self.absolute, self.deltas, strict=True)
        return [value - at if delta else value for value, at, delta in columns]

    def onwards(self, parts: Sequence[float], pace: float) -> list[float]:
        """Return commands from what was sent on: shares of the velocity limit, for each joint."""
        columns = zip(self.absolute, parts, self.rates, self.velocities, strict=True)
        return self.command([
            pace * part * rate if velocity else at + pace * part * rate * self.period
            for at, part, rate, velocity in columns
        ])  # fmt: skip

    @property
    def rates(self) -> list[float]:
        """The velocity limit of each joint; a twentieth of its range in a period for one without."""
        return [
            0.05 * (high - low) / self.period
            if joint.command == "range"
            else max(-joint.velocity[0], joint.velocity[1])
            for joint, low, high in zip(self.joints, self.low, self.high, strict=True)
        ]


class Segment(NamedTuple):
    """Draws of one segment.

    Args:
        unit: (steps, joints) in [-1, 1].
        signs: of each joint.
        pace: as a share of the velocity limits.
        phases: of each joint, in rad.
        random: for single draws.
    """

    unit: list[list[float]]
    signs: list[float]
    pace: float
    phases: list[float]
    random: np.random.Generator

    @classmethod
    def draw(cls, steps: int, width: int, random: np.random.Generator) -> Segment:
        """Return the draws for so many steps."""
        unit = random.uniform(-1, 1, (steps, width)).tolist()
        pace = float(random.choice([0.2, 0.9, 1.0, 1.0, 1.1, 2.5]))
        return cls(unit, random.choice([-1.0, 1.0], width).tolist(), pace, random.uniform(0, 6, width).tolist(), random)


def _anywhere(robot: Robot, part: Segment, step: int) -> Any:
    columns = zip(robot.low, robot.high, part.unit[step], strict=True)
    return robot.command([(low + high) / 2 + 0.6 * unit * (high - low) for low, high, unit in columns])


def _alternate(robot: Robot, part: Segment, step: int, half: int) -> Any:
    flip = -1.0 if step % (2 * half) < half else 1.0
    return robot.onwards([flip * sign for sign in part.signs], part.pace)


def _park(robot: Robot, part: Segment, step: int) -> Any:
    """Go to the ends of the range at full speed, and ask for more there."""
    if robot.mode == "velocity":
        return robot.onwards(part.signs, part.pace)
    reach = [rate * part.pace * robot.period for rate in robot.rates]
    ends = [high if sign > 0 else low for low, high, sign in zip(robot.low, robot.high, part.signs, strict=True)]
    columns = zip(ends, robot.absolute, reach, strict=True)
    wanted = [min(max(end, at - far), at + far) for end, at, far in columns]
    rates = [sign * rate for sign, rate in zip(part.signs, robot.rates, strict=True)]
    return robot.command([
        rate if velocity else value for rate, value, velocity in zip(rates, wanted, robot.velocities, strict=True)
    ])  # fmt: skip


def _storm(robot: Robot, part: Segment, step: int) -> Any:
    command = robot.onwards(part.unit[step], part.pace)
    if part.unit[step][0] > -0.5:
        command[int(part.random.integers(len(command)))] = BAD_NUMBERS[step % 3]
    return np.array(command) if step % 2 else command


def _seams(robot: Robot, part: Segment, step: int) -> Any:
    flip = 1.0 if step % 16 < 8 else -1.0
    columns = zip(part.signs, part.unit[step], strict=True)
    return robot.onwards([flip * sign * (0.6 + 0.4 * unit) for sign, unit in columns], 1.0)


KINDS: dict[str, Callable[[Robot, Segment, int], Any]] = {
    "anywhere": _anywhere,
    "bang-bang": lambda robot, part, step: _alternate(robot, part, step, 20),
    "sign flips": lambda robot, part, step: _alternate(robot, part, step, 1),
    "parking": _park,
    "beyond": lambda robot, part, step: robot.onwards(part.signs, part.pace),
    "storm": _storm,
    "missed": lambda robot, part, step: None if part.unit[step][0] > 0 else robot.onwards(part.signs, part.pace),
    "smooth": lambda robot, part, step: robot.onwards([0.7 * math.sin(x + 0.1 * step) for x in part.phases], 1.0),
    "seams": _seams,
    "crawl": lambda robot, part, step: robot.onwards(part.unit[step], 1e-6),
    "huge": lambda robot, part, step: [1e308 * unit for unit in part.unit[step]],
    "shapes": lambda robot, part, step: WRONG[int(part.random.integers(len(WRONG)))],
}
"""Kind of segment -> the command at a step of it."""


def attack(
    robot: Robot, steps: int, random: np.random.Generator, kinds: Sequence[str] = tuple(KINDS)
) -> dict[str, float]:
    """Take so many steps from one start, in segments of random kinds, with jitter, late steps and odd calls.

    Returns:
        The largest excess of position, velocity, acceleration and jerk.
    """
    robot.begin(random)
    left = steps
    while left > 0:
        length = min(left, int(random.integers(4, 120)))
        left -= length
        make = KINDS[str(random.choice(list(kinds)))]
        part = Segment.draw(length, len(robot.joints), random)
        more = {} if random.random() < 0.95 else {"enabled": False}
        for step, interval in enumerate(intervals(length, robot, random)):
            robot.step(make(robot, part, step), interval, **more)
        if not robot.envelope.at_rest():
            refused(UsageError, robot.envelope.clear)
            refused(UsageError, lambda: robot.envelope.start(robot.start))
    for _ in range(LONGEST_STOP):
        if robot.envelope.at_rest():
            return robot.judge()
        robot.step(None, robot.period)
    raise AssertionError(f"the robot does not stop in {LONGEST_STOP} periods")


def intervals(length: int, robot: Robot, random: np.random.Generator) -> list[float]:
    """Return the times between steps: constant, jitter of 0.5 to 3 periods, or now and then a long gap."""
    choices: tuple[Any, ...] = (
        np.ones(length), random.uniform(0.5, 3, length), random.choice([0.5, 1, 3], length),
        random.choice([1, 1, 1, 1, robot.gap, 2], length),
    )  # fmt: skip
    found: list[float] = (robot.period * choices[int(random.integers(4))]).tolist()
    return found


def refused(error: type[Exception], call: Callable[[], object]) -> None:
    """Fail unless a call raises an error."""
    try:
        call()
    except error:
        return
    raise AssertionError(f"no {error.__name__}")
