"""The fastest stop of one joint that keeps its acceleration and jerk, in closed form and in plain floats.

A joint with velocity v and acceleration a stops soonest when its jerk is at the limit, then 0 while its acceleration is
at the limit, then at the limit with the other sign (the double integrator's time-optimal law, as Ruckig's interface for
velocities has it: Berscheid and Kroeger, "Jerk-limited Real-time Trajectory Generation with Arbitrary Target States",
2021). It depends on v and a alone, so a proven stop is stored as position, velocity and acceleration at its start.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Range = tuple[float, float, float, float]
Phases = tuple[float, float, float, float]


def stop_phases(velocity: float, acceleration: float, max_acceleration: float, max_jerk: float) -> Phases:
    """Return the three durations of the stop, in s, and the jerk of the first; that of the last has the other sign.

    Args:
        velocity: at the start, in units/s.
        acceleration: at the start, in units/s^2.
        max_acceleration: limit of its magnitude; a start above it is not made worse.
        max_jerk: limit of the magnitude of the jerk, in units/s^3.

    Example:
        >>> stop_phases(1.0, 0.0, 2.0, 8.0)
        (0.25, 0.25, 0.25, -8.0)
    """
    sign = 1.0 if velocity + acceleration * abs(acceleration) / (2 * max_jerk) >= 0 else -1.0
    velocity, acceleration = sign * velocity, sign * acceleration
    peak = sqrt(max(0.0, max_jerk * velocity + acceleration * acceleration / 2))
    constant = 0.0
    if peak > max_acceleration:
        peak = max(max_acceleration, -acceleration)
        squares = (acceleration * acceleration / 2 - peak * peak) / max_jerk
        constant = max(0.0, (velocity + squares) / peak)
    return max(0.0, (acceleration + peak) / max_jerk), constant, peak / max_jerk, -sign * max_jerk


def stop_state(
    position: float, velocity: float, acceleration: float, phases: Phases, time: float
) -> tuple[float, float]:
    """Return position and velocity at a time after the start of a stop, at rest at its end.

    Args:
        phases: as ``stop_phases`` returns them for this velocity and acceleration.
        time: in s, from 0; infinity gives the end.
    """
    first, constant, last, jerk = phases
    step = first if first < time else time
    position += step * (velocity + step * (acceleration / 2 + step * jerk / 6))
    velocity += step * (acceleration + step * jerk / 2)
    if time <= first:
        return position, velocity
    acceleration += step * jerk
    time -= step
    step = constant if constant < time else time
    position += step * (velocity + step * (acceleration / 2))
    velocity += step * acceleration
    if time <= constant:
        return position, velocity
    time -= step
    step = last if last < time else time
    position += step * (velocity + step * (acceleration / 2 - step * jerk / 6))
    velocity += step * (acceleration - step * jerk / 2)
    return position, velocity if time <= last else 0.0


def stop_positions(position: Array, velocity: Array, acceleration: Array, phases: Array, times: Array) -> Array:
    """Return positions of many stops at many times, bit for bit those of ``stop_state``.

    Args:
        position, velocity, acceleration: (A,) at the start of each.
        phases: (4, A), as ``stop_phases`` returns them for each.
        times: (K, A) in s, from 0, after the start of each.

    Returns:
        (K, A) float64.
    """
    first, constant, last, jerk = phases
    step = np.minimum(first, times)
    position = position + step * (velocity + step * (acceleration / 2 + step * jerk / 6))
    velocity = velocity + step * (acceleration + step * jerk / 2)
    acceleration, times = acceleration + step * jerk, times - step
    step = np.minimum(constant, times)
    position += step * (velocity + step * (acceleration / 2))
    velocity += step * acceleration
    step = np.minimum(last, times - step)
    position += step * (velocity + step * (acceleration / 2 - step * jerk / 6))
    return position


def stop_range(velocity: float, acceleration: float, max_acceleration: float, max_jerk: float) -> Range:
    """Return how far a stop goes and how fast: least and greatest displacement and velocity, in units and units/s.

    The displacements include 0, the start. Arguments as for ``stop_phases``.

    Example:
        >>> stop_range(1.0, 0.0, 2.0, 8.0)
        (0.0, 0.375, 0.0, 1.0)
    """
    square = acceleration * acceleration / 2
    backward = velocity * max_jerk < (square if acceleration < 0 else -square)
    if backward:
        velocity, acceleration = -velocity, -acceleration
    radicand = max_jerk * velocity + square
    peak, constant = sqrt(radicand) if radicand > 0 else 0.0, 0.0
    if peak > max_acceleration:
        peak = max_acceleration if max_acceleration > -acceleration else -acceleration
        constant = (velocity + (square - peak * peak) / max_jerk) / peak
    first = (acceleration + peak) / max_jerk
    high = (
        first * (velocity + first * (acceleration / 2 - first * max_jerk / 6))
        + constant * peak * (peak / max_jerk + constant) / 2
        + peak * peak * peak / (6 * max_jerk * max_jerk)
    )
    fastest = velocity + square / max_jerk if acceleration > 0 else velocity
    low = slowest = 0.0
    if velocity < 0:
        turn = (acceleration - sqrt(max(0.0, 2 * radicand))) / max_jerk
        low = turn * (velocity + turn * (acceleration / 2 - turn * max_jerk / 6))
        high, slowest = max(0.0, high), velocity
    return (-high, -low, -fastest, -slowest) if backward else (low, high, slowest, fastest)
