from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from vlatool.errors import ProfileError
from vlatool.hardware.platforms import load_platform, platform_names

VALID = {"name": "mine", "title": "t", "control_hz": 10, "compute_watts": 20, "sensors": ["camera"], "kind": "estimate",
         "source": "s"}  # fmt: skip


def write(folder: Path, **changes: Any) -> Path:
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in (VALID | changes).items() if value != "absent"}))
    return path


@pytest.mark.parametrize("name", platform_names())
def test_shipped_platforms_are_sound(name: str) -> None:
    found = load_platform(name)
    assert found.name == name
    assert 1 <= found.control_hz <= 1000
    assert 1 <= found.compute_watts <= 1000
    assert found.source
    assert found.sensors


def test_there_is_a_platform_for_each_kind_of_robot() -> None:
    assert {"arm", "bimanual", "mobile-manipulator", "quadcopter", "quadruped"} <= {*platform_names()}


def test_mains_power_has_no_battery() -> None:
    assert load_platform("arm").battery_wh is None
    assert load_platform("quadcopter").battery_wh


def test_a_platform_may_be_a_file(tmp_path: Path) -> None:
    found = load_platform(write(tmp_path, battery_wh=100))
    assert (found.control_hz, found.battery_wh) == (10.0, 100.0)


def test_an_unknown_name_gets_the_nearest() -> None:
    with pytest.raises(ProfileError, match="Unknown platform 'quadcoptre'; did you mean 'quadcopter'"):
        load_platform("quadcoptre")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"control_hz": "absent"}, "control_hz: Field required"),
        ({"control_hz": 0}, "control_hz: Input should be greater than 0"),
        ({"compute_watts": -5}, "compute_watts: Input should be greater than 0"),
        ({"battery_wh": 0}, "battery_wh: Input should be greater than 0"),
        ({"sensors": []}, "sensors: "),
        ({"name": "My Robot"}, "name: String should match pattern"),
        ({"kind": "guess"}, "kind: "),
        ({"colour": "red"}, "colour: is not a known key"),
        ({"sensor": ["imu"]}, "sensor: is not a known key; did you mean 'sensors'?"),
        ({"control_hz": "often"}, "control_hz: "),
        ({"control_hz": float("inf")}, "control_hz: "),
        ({"compute_watts": float("nan")}, "compute_watts: "),
    ],
    ids=str,
)
def test_a_malformed_platform_names_the_field(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ProfileError) as caught:
        load_platform(write(tmp_path, **changes))
    assert says in caught.value.message


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"name: [", "is not valid YAML"), (b"\xff\xfe\x00", "is not valid YAML"), (b"- a\n", "is malformed"),
     (b"", "is malformed")],
)  # fmt: skip
def test_what_is_no_platform_is_refused(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "mine.yaml").write_bytes(content)
    with pytest.raises(ProfileError, match=says):
        load_platform(tmp_path / "mine.yaml")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="cannot be read: No such file"):
        load_platform(tmp_path / "none.yaml")
