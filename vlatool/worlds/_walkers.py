"""Things that walk through a room from place to place, around pillars and pits, and give way to the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from vlatool.worlds._indoor_scene import Scene, Thing


@dataclass
class Walkers:
    """Moving things of a scene.

    Args:
        scene: The room.
        yield_m: Distance from the edge of the robot within which they do not come nearer.
        radius_m: Radius of the robot.
        random: Source of chance.
        places: Name -> (x, y) in metres.
    """

    scene: Scene
    yield_m: float
    radius_m: float
    random: np.random.Generator
    places: dict[str, tuple[float, float]] = field(default_factory=dict)
    _goals: dict[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.places = {thing.name: (thing.x, thing.y) for thing in self.scene.movers}

    def advance(self, seconds: float, robot: tuple[float, float]) -> None:
        """Walk for this long, while the centre of the robot is at a place."""
        for thing in self.scene.movers:
            x, y = self.places[thing.name]
            goal = self._goals.get(thing.name)
            if goal is None or math.hypot(goal[0] - x, goal[1] - y) < 0.1:
                goal = self._goals[thing.name] = self._draw_goal()
            way = math.hypot(goal[0] - x, goal[1] - y)
            step = min(thing.speed * seconds, way)
            new = (x + (goal[0] - x) / way * step, y + (goal[1] - y) / way * step)
            if self._is_blocked(thing, new):
                self._goals[thing.name] = self._draw_goal()
            elif not self._gives_way(thing, (x, y), new, robot):
                self.places[thing.name] = new

    def _draw_goal(self) -> tuple[float, float]:
        reach = self.scene.size_m / 2 - 0.5
        x, y = self.random.uniform(-reach, reach, 2)
        return float(x), float(y)

    def _is_blocked(self, thing: Thing, position: tuple[float, float]) -> bool:
        others = [(t.x, t.y, t.radius) for t in self.scene.pillars]
        others += [(*self.places[t.name], t.radius) for t in self.scene.movers if t.name != thing.name]
        old = self.places[thing.name]
        return any(
            _apart(position, (x, y)) < thing.radius + radius + 0.1 and _apart(position, (x, y)) < _apart(old, (x, y))
            for x, y, radius in others
        )

    def _gives_way(
        self, thing: Thing, old: tuple[float, float], new: tuple[float, float], robot: tuple[float, float]
    ) -> bool:
        near = _apart(new, robot) < thing.radius + self.radius_m + self.yield_m
        return near and _apart(new, robot) < _apart(old, robot)


def _apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    return math.hypot(one[0] - other[0], one[1] - other[1])
