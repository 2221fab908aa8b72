"""Limits of robots, with a source for each: ``profiles/robots/*.yaml``, and the JSON that a robot reads.

A robot has no YAML reader: ``robots_json`` is what ``vlatool/runtime/envelope/robots.json`` holds. ``make docs`` writes
both that file and the table in ``docs/reference/robots.md``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator

from vlatool.errors import ProfileError
from vlatool.files.yaml import read_mapping
from vlatool.hardware._problems import describe_problem
from vlatool.hardware.profile import NAME, Strict

POSITION, MOTION = ("low", "high"), ("velocity", "acceleration", "jerk")
CURVE = ("curve_offset", "curve_slope", "curve_low", "curve_high")
Number = float | tuple[float, float] | None


class Row(Strict):
    """One limit of each joint of a part.

    Args:
        values: in SI units; a pair is a least and a greatest velocity, null stands for none.
        source: key of the robot's ``sources``.
        assumed: whether nobody published them.
    """

    values: tuple[Number, ...] = Field(min_length=1)
    source: str
    assumed: bool = False
    note: str = ""


class Part(Strict):
    """Joints whose limits have the same sources.

    Args:
        joints: names, in the order of the action.
        units: of their positions.
        command: ``velocity`` for a base, ``range`` for a gripper; see ``vlatool.runtime.envelope.JointLimits``.
        low: least positions; None without any.
        curve_offset: with the other three, velocity limits that depend on the position.
    """

    joints: tuple[str, ...] = Field(min_length=1)
    units: tuple[Literal["rad", "m"], ...]
    command: Literal["", "velocity", "range"] = ""
    prefixes: tuple[str, ...] = ("",)
    low: Row | None = None
    high: Row | None = None
    velocity: Row | None = None
    acceleration: Row | None = None
    jerk: Row | None = None
    curve_offset: Row | None = None
    curve_slope: Row | None = None
    curve_low: Row | None = None
    curve_high: Row | None = None

    def rows(self) -> dict[str, Row]:
        """Return the limits that there are, by name."""
        found = {name: getattr(self, name) for name in (*POSITION, *MOTION, *CURVE)}
        return {name: row for name, row in found.items() if row is not None}

    @model_validator(mode="after")
    def _check_widths(self) -> Part:
        for name, row in {"units": self.units, **{key: row.values for key, row in self.rows().items()}}.items():
            if len(row) != len(self.joints):
                raise ValueError(f"{name}: has {len(row)} values for {len(self.joints)} joints")
        return self


class Robot(Strict):
    """Limits of a robot.

    Args:
        prefixes: of a part: the part is there once for each, one after the other with those of its neighbours.
    """

    name: str = Field(pattern=NAME)
    title: str
    space: Literal["joint", "cartesian"]
    parts: tuple[Part, ...] = Field(min_length=1)
    sources: dict[str, str] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_sources(self) -> Robot:
        for row in (row for part in self.parts for row in part.rows().values()):
            if row.source not in self.sources:
                raise ValueError(f"the source '{row.source}' is not in sources")
            if row.assumed and not row.note:
                raise ValueError("an assumption needs a note that says what it rests on")
        return self

    def limits(self) -> dict[str, Any]:
        """Return the limits as ``vlatool.runtime.envelope.RobotLimits.from_dict`` takes them, without the name."""
        joints, assumed = [], []
        for prefix in self.parts[0].prefixes:
            for part in self.parts:
                joints += [_joint(part, index, prefix) for index in range(len(part.joints))]
                rows = [name for name, row in part.rows().items() if row.assumed]
                assumed += [f"{prefix}{joint}.{name}" for joint in part.joints for name in rows]
        return {"space": self.space, "joints": joints, "assumed": sorted(assumed)}


def robot_folder() -> Path:
    """Return the folder of the robots that are shipped."""
    package = Path(__file__).resolve().parents[1]
    return next(
        folder for folder in (package / "_profiles/robots", package.parent / "profiles/robots") if folder.is_dir()
    )


def load_robot(path: Path) -> Robot:
    """Read a robot from a YAML file; raises ProfileError, which says what is wrong in it."""
    data = read_mapping(path, f"The robot {path}", ProfileError)
    try:
        return Robot.model_validate(data)
    except ValidationError as error:
        known = {key for model in (Robot, Part, Row) for key in model.model_fields}
        problems = [describe_problem(item, known) for item in error.errors(include_url=False)]
        raise ProfileError(
            f"The robot {path} is malformed: {'; '.join(problems)}.", "correct it in the file"
        ) from error


def robots() -> list[Robot]:
    """Return the robots that are shipped, by name."""
    return [load_robot(path) for path in sorted(robot_folder().glob("*.yaml"), key=lambda path: path.stem)]


def robots_json() -> str:
    """Return the text of ``vlatool/runtime/envelope/robots.json``: name -> limits, one joint on a line."""
    blocks = []
    for robot in robots():
        limits = robot.limits()
        joints = ",\n   ".join(json.dumps(joint) for joint in limits.pop("joints"))
        blocks.append(f' "{robot.name}": {json.dumps(limits)[:-1]}, "joints": [\n   {joints}]}}')
    return "{\n" + ",\n".join(blocks) + "\n}\n"


def robots_page() -> str:
    """Return the text of ``docs/reference/robots.md``."""
    about = "From `profiles/robots/`. Units are SI; an assumption is a limit that nobody published."
    lines = ["# Limits of robots\n", f"{about}\n"]
    for robot in robots():
        lines += [f"## {robot.name}\n", f"{robot.title}.\n"]
        for part in robot.parts:
            lines += [*_table(robot, part), ""]
    return "\n".join(lines).rstrip() + "\n"


def _table(robot: Robot, part: Part) -> Iterator[str]:
    joints = [f"{joint} ({unit})" for joint, unit in zip(part.joints, part.units, strict=True)]
    yield f"| limit | {' | '.join(joints)} | source |"
    yield "|---" * (len(part.joints) + 2) + "|"
    for name, row in part.rows().items():
        values = " | ".join("none" if value is None else _text(value) for value in row.values)
        said = "; ".join(filter(None, ["**assumed**" if row.assumed else robot.sources[row.source], row.note]))
        yield f"| {name.replace('_', ' ')} | {values} | {said} |"


def _text(value: float | tuple[float, float]) -> str:
    return f"{value[0]:g} to {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"


def _joint(part: Part, index: int, prefix: str) -> dict[str, Any]:
    joint: dict[str, Any] = {"name": prefix + part.joints[index], "unit": part.units[index]}
    if part.command:
        joint["command"] = part.command
    values = {name: row.values[index] for name, row in part.rows().items()}
    joint |= {name: values[name] for name in (*POSITION, *MOTION) if values.get(name) is not None}
    if CURVE[0] in values:
        joint["curve"] = {name.removeprefix("curve_"): values[name] for name in CURVE}
    return joint
