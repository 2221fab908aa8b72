"""Robot platforms: what a robot of a kind usually has and allows, as a starting point for ``hwselect``."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import Field, ValidationError

from vlatool.errors import ProfileError
from vlatool.files.printable import reason_of
from vlatool.files.yaml import read_yaml
from vlatool.hardware._problems import describe_problem
from vlatool.hardware.profile import NAME, SUFFIXES, Kind, Strict


class Platform(Strict):
    """A kind of robot.

    Args:
        control_hz: Rate of the actions.
        compute_watts: Power that battery and cooling leave for the computer.
        battery_wh: None for a robot on mains power.
        sensors: With their rates.
    """

    name: str = Field(pattern=NAME)
    title: str
    control_hz: float = Field(gt=0)
    compute_watts: float = Field(gt=0)
    battery_wh: float | None = Field(None, gt=0)
    sensors: tuple[str, ...] = Field(min_length=1)
    note: str = ""
    kind: Kind
    source: str


def platform_names() -> list[str]:
    """List the platforms that are shipped."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def load_platform(name_or_path: str | os.PathLike[str]) -> Platform:
    """Read a platform by name, or from a YAML file of the user.

    Raises:
        ProfileError: when there is none, or it is malformed.

    Example:
        >>> load_platform("quadcopter").compute_watts
        15.0
    """
    name = os.fspath(name_or_path)
    own = name.endswith(SUFFIXES) or os.sep in name
    path = Path(name) if own else _folder() / f"{name}.yaml"
    if not own and name not in platform_names():
        raise ProfileError.unknown(f"Unknown platform '{name}'", name, platform_names())
    try:
        return Platform.model_validate(read_yaml(path, f"The platform {path}", ProfileError))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        problem = f"{'.'.join(map(str, first['loc']))}: {reason_of(first['msg'])}"
        if first["type"] == "extra_forbidden":
            problem = describe_problem(first, Platform.model_fields)
        raise ProfileError(
            f"The platform {path} is malformed: {problem.rstrip('.')}.",
            "correct it in the file; the platforms that come with vlatool show what belongs there",
        ) from error


def _folder() -> Path:
    return Path(__file__).with_name("data") / "platforms"
