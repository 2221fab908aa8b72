"""An independent judge of what an envelope sent: divided differences in numpy, none of the envelope's code.

Of commands x_k sent at t_k, the difference of order n is n! times the divided difference of n + 1 neighbours, which at
a constant rate is the usual finite difference. Positions have their velocity, acceleration and jerk in the orders 1 to
3; velocities are themselves the velocity, and have the others in the orders 1 and 2, and a position that is the sum of
velocity times interval. Before the first command, the robot has rested for three periods.

An excess is what lies above a limit, less what rounding of positions alone can cause: 2^n eps |x| / h^n of order n for
the shortest interval h among those it spans.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.envelope import RobotLimits, VelocityCurve

Array = NDArray[Any]
EPS = float(np.finfo(np.float64).eps)


def excesses(
    limits: RobotLimits, velocities: list[bool], start: list[float], times: list[float], sent: list[tuple[float, ...]],
    period: float,
) -> dict[str, float]:  # fmt: skip
    """Return the largest excess of position, velocity, acceleration and jerk over all joints; at most 0 is legal.

    Args:
        limits: of the robot.
        velocities: whether each element of a command is a velocity.
        start: position at which the robot rested.
        times: at which the commands were sent, the robot having started at 0.
        sent: absolute commands.
        period: nominal interval.
    """
    at = np.concatenate([period * np.arange(-3, 1), times])
    worst = dict.fromkeys(("position", "velocity", "acceleration", "jerk"), -np.inf)
    columns = np.array(sent, float).T
    for joint, column, is_velocity, first in zip(limits.joints, columns, velocities, start, strict=True):
        values = np.concatenate([np.full(4, 0.0 if is_velocity else first), column])
        low, high = joint.bounds
        if joint.command == "range":
            worst["position"] = max(worst["position"], *(values - high), *(low - values))
            continue
        positions = values
        if is_velocity:
            positions = first + np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(at))])
        worst["position"] = max(worst["position"], float((positions - high).max()), float((low - positions).max()))
        orders = differences(at, values, 2 if is_velocity else 3)
        motion = [(values, 0.0), *orders] if is_velocity else orders
        for name, (rates, rounding), limit in zip(
            ("velocity", "acceleration", "jerk"), motion,
            (None, joint.acceleration, joint.jerk), strict=True,
        ):  # fmt: skip
            slow, fast = joint.velocity if limit is None else (-limit, limit)
            over = np.maximum(rates - fast, slow - rates) - rounding
            worst[name] = max(worst[name], float(over.max()))
        if joint.curve is not None and not is_velocity:
            worst["velocity"] = max(worst["velocity"], over_curve(joint.curve, values, orders[0][0]))
    return worst


def differences(at: Array, values: Array, orders: int) -> list[tuple[Array, Array]]:
    """Return n! times the divided differences of the orders 1 to n, and what rounding may cause in each."""
    found, rates, gaps = [], values, np.diff(at)
    for order in range(1, orders + 1):
        rates = np.diff(rates) * order / (at[order:] - at[:-order])
        shortest = np.lib.stride_tricks.sliding_window_view(gaps, order).min(axis=1)
        found.append((rates, 2**order * EPS * np.abs(values).max() / shortest**order))
    return found


def over_curve(curve: VelocityCurve, positions: Array, rates: Array) -> float:
    """Return how far velocities are above what a curve allows at the position where each step began."""
    before = positions[:-1]
    up = np.maximum(0, np.sqrt(np.maximum(0, curve.slope * (curve.high - before))) - curve.offset)
    down = np.maximum(0, np.sqrt(np.maximum(0, curve.slope * (before - curve.low))) - curve.offset)
    return float(np.maximum(rates - up, -rates - down).max())
