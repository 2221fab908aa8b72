"""What a safety monitor holds against a robot: one table from conditions to levels, and how levels fall.

All that decides is here, in a form that can be read line by line: ``TABLE`` says which condition asks for which level,
``next_level`` how the level follows. ``_safety_facts`` measures the facts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import NamedTuple


class Level(IntEnum):
    """How much of the speed is left."""

    NORMAL = 0
    WARNING = 1
    CRITICAL = 2
    EMERGENCY = 3


SCALES = {Level.NORMAL: 1.0, Level.WARNING: 0.5, Level.CRITICAL: 0.2, Level.EMERGENCY: 0.0}
"""Level -> factor of the speed."""
FULL = 1.05
"""Charge above which it is none from 0 to 1, such as one in percent, of which the limits say nothing."""
FALL_S = 1.0
"""Time without a condition of its own after which a level falls by one step, in seconds."""


class Limits(NamedTuple):
    """Limits of the table; distances in metres, times in seconds, currents in amperes."""

    warning_m: float = 0.6
    critical_m: float = 0.4
    emergency_m: float = 0.25
    battery_warning: float = 0.2
    battery_critical: float = 0.1
    battery_emergency: float = 0.05
    current_critical_a: float = 3.0
    current_emergency_a: float = 6.0
    fence_warning_m: float = 0.3
    task_s: float = 600.0
    silence_s: float = 1.0


class Facts(NamedTuple):
    """What was measured at a step.

    Args:
        clearance_m: Way ahead until the base would touch something, along the path that is commanded; inf without one.
        blind: Whether no range sensor sees the way that is commanded.
        sensor_out: Whether an expected sensor is too old, repeats itself or has a gap on the way that is commanded.
        cliff: Whether the floor ahead is missing, while the command is to drive forward.
        jump: Whether the pose changed more than the robot can move.
        battery: Charge, from 0 to 1; NaN where unknown.
        current_a: Largest current of a motor; NaN where unknown.
        fence_m: Distance to the fence from inside, negative outside; inf without a fence.
        task_s: How long the task has been running; 0 where none is.
        illegal: Whether the state of the task changed as it cannot.
        person: Whether a person is in the workspace.
        silence_s: Time since the last command; 0 before the first.
        stop: Whether the emergency stop is pressed.
        finite: Whether the command is made of finite numbers.
        failure: Whether the monitor itself failed.
    """

    clearance_m: float = math.inf
    blind: bool = False
    sensor_out: bool = False
    cliff: bool = False
    jump: bool = False
    battery: float = math.nan
    current_a: float = math.nan
    fence_m: float = math.inf
    task_s: float = 0.0
    illegal: bool = False
    person: bool = False
    silence_s: float = 0.0
    stop: bool = False
    finite: bool = True
    failure: bool = False


class Rule(NamedTuple):
    """A line of the table: the level that a condition asks for."""

    name: str
    level: Level
    holds: Callable[[Facts, Limits], bool]


W, C, E = Level.WARNING, Level.CRITICAL, Level.EMERGENCY
TABLE: tuple[Rule, ...] = (
    Rule("obstacle in the outer band", W, lambda facts, limits: facts.clearance_m <= limits.warning_m),
    Rule("obstacle in the middle band", C, lambda facts, limits: facts.clearance_m <= limits.critical_m),
    Rule("obstacle in the inner band", E, lambda facts, limits: facts.clearance_m <= limits.emergency_m),
    Rule("sensor out", C, lambda facts, _: facts.sensor_out),
    Rule("no sensor sees the way", E, lambda facts, _: facts.blind),
    Rule("cliff ahead", E, lambda facts, _: facts.cliff),
    Rule("localisation jumped", C, lambda facts, _: facts.jump),
    Rule("battery low", W, lambda facts, limits: facts.battery < limits.battery_warning or facts.battery > FULL),
    Rule("battery very low", C, lambda facts, limits: facts.battery < limits.battery_critical),
    Rule("battery empty", E, lambda facts, limits: facts.battery < limits.battery_emergency),
    Rule("motor current high", C, lambda facts, limits: facts.current_a > limits.current_critical_a),
    Rule("motor current very high", E, lambda facts, limits: facts.current_a > limits.current_emergency_a),
    Rule("near the fence", W, lambda facts, limits: facts.fence_m < limits.fence_warning_m),
    Rule("outside of the fence", E, lambda facts, _: facts.fence_m < 0.0),
    Rule("task takes too long", C, lambda facts, limits: facts.task_s > limits.task_s),
    Rule("illegal change of the task's state", C, lambda facts, _: facts.illegal),
    Rule("person in the workspace", C, lambda facts, _: facts.person),
    Rule("no command", W, lambda facts, limits: facts.silence_s > limits.silence_s),
    Rule("command is not finite", C, lambda facts, _: not facts.finite),
    Rule("emergency stop pressed", E, lambda facts, _: facts.stop),
    Rule("the monitor failed", E, lambda facts, _: facts.failure),
)
"""Conditions, and the level that each asks for; the highest counts."""


def conditions(facts: Facts, limits: Limits, table: Sequence[Rule] = TABLE) -> list[Rule]:
    """Return the lines of the table that hold."""
    return [rule for rule in table if rule.holds(facts, limits)]


def highest(rules: Sequence[Rule]) -> Level:
    """Return the level that lines of the table ask for; NORMAL without one."""
    return max((rule.level for rule in rules), default=Level.NORMAL)


class Status(NamedTuple):
    """A level, and since when no condition asks for it, in seconds of ``Snapshot.time_s``; None while one does."""

    level: Level = Level.NORMAL
    clear_s: float | None = None


def next_level(status: Status, demand: Level, time_s: float) -> Status:
    """Return the level after a step: up at once, down by one step for each ``FALL_S`` that it is clear.

    EMERGENCY stays until it is released.
    """
    if demand >= status.level:
        return Status(demand)
    if status.level is Level.EMERGENCY:
        return Status(Level.EMERGENCY)
    if status.clear_s is None:
        return Status(status.level, time_s)
    if time_s - status.clear_s >= FALL_S:
        return Status(Level(status.level - 1), time_s)
    return status


def release(status: Status, demand: Level, time_s: float) -> Status:
    """Return the level after an operator released EMERGENCY: CRITICAL, unless a condition asks for EMERGENCY now."""
    if status.level is not Level.EMERGENCY or demand is Level.EMERGENCY:
        return status
    return Status(Level.CRITICAL, time_s)
