"""Rooms of primitives: walls, pillars, pits in the floor, moving obstacles, people, a target; as a MuJoCo model."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

MAX_TRIES = 200
"""Places that are tried for a thing before it is left out of a room that is full."""


class Thing(NamedTuple):
    """A round thing that stands or moves: its place and radius in metres, its height, its speed in m/s."""

    name: str
    x: float
    y: float
    radius: float
    height: float
    speed: float = 0.0


class Pit(NamedTuple):
    """A rectangle without floor, in metres."""

    left: float
    low: float
    right: float
    high: float


@dataclass
class Scene:
    """A square room around the origin, in which the robot starts at the origin.

    Args:
        size_m: Side of the room.
        pillars: Things that stand.
        movers: Things that move, people among them.
        pits: Rectangles without floor.
        colours: (N, 3) colours of the pillars, from 0 to 1.
    """

    size_m: float
    pillars: list[Thing] = field(default_factory=list)
    movers: list[Thing] = field(default_factory=list)
    pits: list[Pit] = field(default_factory=list)
    colours: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


def draw_scene(size_m: float, counts: dict[str, int], random: np.random.Generator) -> Scene:
    """Return a room with so many ``pillars``, ``cliffs``, ``movers`` and ``people``, at random places."""
    scene = Scene(size_m)
    for index in range(counts["cliffs"]):
        position = _free_place(scene, 0.4, 1.1, random)
        if position is not None:
            scene.pits.append(Pit(position[0] - 0.3, position[1] - 0.3, position[0] + 0.3, position[1] + 0.3))
        del index
    kinds = (
        ("pillar", "pillars", scene.pillars),
        ("mover", "movers", scene.movers),
        ("person", "people", scene.movers),
    )
    for kind, key, group in kinds:
        for index in range(counts[key]):
            radius = {"pillar": random.uniform(0.06, 0.25), "mover": 0.15, "person": 0.2}[kind]
            position = _free_place(scene, radius, 0.7, random)
            if position is not None:
                height = {"pillar": 0.8, "mover": 0.5, "person": 1.7}[kind]
                speed = {"pillar": 0.0, "mover": 0.25, "person": 0.8}[kind]
                group.append(Thing(f"{kind}{index}", *position, radius, height, speed))
    scene.colours = random.uniform(0.2, 0.9, (len(scene.pillars), 3))
    return scene


def _free_place(
    scene: Scene, radius: float, from_start: float, random: np.random.Generator
) -> tuple[float, float] | None:
    """Return a place with 0.5 m around it, so far from the start; None where none was found."""
    for _ in range(MAX_TRIES):
        x, y = random.uniform(-scene.size_m / 2 + radius + 0.3, scene.size_m / 2 - radius - 0.3, 2)
        apart = all(math.hypot(x - t.x, y - t.y) > radius + t.radius + 0.5 for t in (*scene.pillars, *scene.movers))
        away = all(math.hypot(x - (p.left + p.right) / 2, y - (p.low + p.high) / 2) > radius + 0.9 for p in scene.pits)
        if apart and away and math.hypot(x, y) > radius + from_start:
            return float(x), float(y)
    return None


def model_text(scene: Scene, robot: str, cameras: str, target: Thing) -> str:
    """Return the MuJoCo model of a room with a robot.

    Args:
        robot: Geoms of the base.
        cameras: Cameras of the base.
        target: A thing that stands below the floor until it is placed; so does ``intruder``.
    """
    half, solid = scene.size_m / 2, 'contype="1" conaffinity="1"'
    walls = "".join(
        f'<geom type="box" pos="{x} {y} 0.4" size="{a} {b} 0.4" rgba="0.75 0.75 0.7 1" {solid}/>'
        for x, y, a, b in (
            (half, 0, 0.05, half), (-half, 0, 0.05, half), (0, half, half, 0.05), (0, -half, half, 0.05)
        )
    )  # fmt: skip
    pillars = "".join(
        f'<geom type="cylinder" pos="{t.x} {t.y} {t.height / 2}" size="{t.radius} {t.height / 2}" '
        f'rgba="{c[0]:.3f} {c[1]:.3f} {c[2]:.3f} 1" {solid}/>'
        for t, c in zip(scene.pillars, scene.colours, strict=True)
    )
    movers = "".join(_mocap(thing, thing.x, thing.y, 0.0, "0.3 0.5 0.8 1") for thing in scene.movers)
    hidden = _mocap(target, 0.0, 0.0, -10.0, "0.9 0.1 0.1 1")
    hidden += _mocap(Thing("intruder", 0, 0, 0.1, 0.5), 0.0, 0.0, -10.0, "0.9 0.8 0.1 1")
    return f"""<mujoco><option timestep="0.01" gravity="0 0 0"/>
    <statistic extent="{scene.size_m}"/><visual><map znear="0.005" zfar="5"/><headlight ambient="0.5 0.5 0.5"/>
    <quality shadowsize="0" offsamples="0"/></visual><worldbody>{_floor(scene)}{walls}{pillars}{movers}{hidden}
    <body name="base"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
    <joint name="yaw" type="hinge" axis="0 0 1"/>{robot}{cameras}</body></worldbody></mujoco>"""


def _mocap(thing: Thing, x: float, y: float, z: float, colour: str) -> str:
    shape = "capsule" if thing.name.startswith("person") else "cylinder"
    half = thing.height / 2 - (thing.radius if shape == "capsule" else 0.0)
    return (
        f'<body name="{thing.name}" mocap="true" pos="{x} {y} {z}"><geom type="{shape}" pos="0 0 {thing.height / 2}" '
        f'size="{thing.radius} {half}" rgba="{colour}" contype="1" conaffinity="1"/></body>'
    )


def _floor(scene: Scene) -> str:
    """Return boxes that cover the room but for its pits, and a ground below."""
    half = scene.size_m / 2
    xs = sorted({-half, half, *(x for pit in scene.pits for x in (pit.left, pit.right))})
    ys = sorted({-half, half, *(y for pit in scene.pits for y in (pit.low, pit.high))})
    tiles = ""
    for left, right in pairwise(xs):
        for low, high in pairwise(ys):
            x, y = (left + right) / 2, (low + high) / 2
            if not any(pit.left < x < pit.right and pit.low < y < pit.high for pit in scene.pits):
                tiles += _slab(x, y, -0.01, (right - left) / 2, (high - low) / 2, "0.45 0.4 0.35 1")
    return tiles + _slab(0.0, 0.0, -0.51, half, half, "0.1 0.1 0.1 1")


def _slab(x: float, y: float, z: float, a: float, b: float, colour: str) -> str:
    return f'<geom type="box" pos="{x} {y} {z}" size="{a} {b} 0.01" rgba="{colour}" contype="0" conaffinity="0"/>'
