"""What one episode looked like: the actions, and what the environment told of the robot's body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Track:
    """One episode of T control steps; a place is known before the first step and after each, P = T + 1 times.

    Environments that tell nothing at the reset are known after each step alone, P = T times.

    Args:
        hz: Control steps per second.
        actions: (T, A) in the units of the spec, or (T,) indices of a discrete action.
        fresh: (T,) whether a step's action was the first of a chunk.
        position: (P, D) of the end effector or the base, in the environment's unit of length; None where not told.
        joints: (P, J) rad (prismatic ones in the unit of length).
        heading: (P,) rad of a base that turns.
        gripper: (P,) opening, 0 (closed) to 1 (open).
        collision: (T,) whether a step ran into something.
        shortest: Length of the shortest path to the goal, in the unit of ``position``.
        alike: Elements of the action that share its most frequent unit; their steps can be added.
        grip: Index of the gripper in the action; None without a gripper.
    """

    hz: float
    actions: Array
    fresh: Array
    position: Array | None = None
    joints: Array | None = None
    heading: Array | None = None
    gripper: Array | None = None
    collision: Array | None = None
    shortest: float | None = None
    alike: tuple[int, ...] = ()
    grip: int | None = None

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def commands(self) -> Array | None:
        """(T, K) the elements of the action that share a unit; None for a discrete action, or when there is none."""
        if self.actions.ndim != 2 or not self.alike:
            return None
        return self.actions[:, list(self.alike)]


def lengths(points: Array) -> Array:
    """Return the Euclidean distances between consecutive points: (P, D) -> (P - 1,)."""
    steps: Array = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return steps


def mean_squared_jerk(points: Array, hz: float) -> float | None:
    """Return the mean squared jerk of a path.

    With velocities v(t) = f (p(t+1) - p(t)), t = 1 .. T, it is f^4 / (T - 2) sum |v(t+1) - 2 v(t) + v(t-1)|^2 (the
    dimensional form that Hogan and Sternad 2009, "Sensitivity of smoothness measures", call mean squared jerk).

    Args:
        points: (P, D).
        hz: f.

    Returns:
        In the unit of the points squared / s^6; None for fewer than four points.
    """
    if len(points) < 4:
        return None
    velocity = hz * np.diff(points, axis=0)
    bend = velocity[2:] - 2 * velocity[1:-1] + velocity[:-2]
    return float(hz**4 * np.square(bend).sum(axis=1).mean())
