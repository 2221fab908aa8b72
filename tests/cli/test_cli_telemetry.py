from __future__ import annotations

import json
from pathlib import Path

import pytest


@pytest.fixture
def jetson(tmp_path: Path) -> Path:
    """A tree with an input rail of 5 V and 2 A, and one temperature."""
    hwmon, zone = tmp_path / "sys/class/hwmon/hwmon3", tmp_path / "sys/class/thermal/thermal_zone0"
    for folder in (hwmon, zone, tmp_path / "proc"):
        folder.mkdir(parents=True)
    for name, text in (("name", "ina3221"), ("in1_label", "VDD_IN"), ("in1_input", "5000"), ("curr1_input", "2000")):
        (hwmon / name).write_text(text + "\n")
    (zone / "type").write_text("cpu-thermal\n")
    (zone / "temp").write_text("48500\n")
    return tmp_path


def test_what_the_board_tells_comes_first_and_what_it_does_not_last(vlatool, jetson) -> None:
    code, out, err = vlatool("telemetry", "--seconds", 0.05, "--period", 0.02, "--root", jetson)
    assert (code, err) == (0, "")
    first, *rest = out.splitlines()
    assert first.startswith("10 W, ")
    assert "module input VDD_IN" in first
    assert "  thermal.cpu-thermal: 48.5 degC" in rest
    where = rest.index("unmeasured:")
    assert any(line.startswith("  rapl: ") for line in rest[where:])
    assert any(line.startswith("throttled: ") for line in rest)
    assert "nan" not in out.lower().replace("nano", "")


def test_json_has_every_sample(vlatool, jetson) -> None:
    code, out, _ = vlatool("telemetry", "--seconds", 0.05, "--period", 0.02, "--root", jetson, "--json")
    assert code == 0
    found = json.loads(out)
    assert found["energy"][0]["mean_w"] == pytest.approx(10)
    gauge = found["gauges"]["thermal.cpu-thermal"]
    assert len(gauge["values"]) == len(gauge["times"]) >= 2
    assert {each["reader"] for each in found["unmeasured"]} >= {"rapl", "vcgencmd"}


def test_a_machine_that_tells_nothing_says_so(vlatool, tmp_path) -> None:
    code, out, _ = vlatool("telemetry", "--seconds", 0.01, "--root", tmp_path)
    assert code == 0
    assert "throttled: not reported by this machine" in out
    assert " 0 W" not in out


@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        (["--seconds", 0], 2, "--seconds is 0; allowed: above 0"),
        (["--seconds", "nan"], 2, "--seconds is nan"),
        (["--period", -1], 2, "--period is -1"),
        (["--root", "/no/such/place"], 3, "No such directory: /no/such/place"),
        (["--seconds", "long"], 2, "valid number"),
    ],
)
def test_what_is_wrong_is_said(vlatool, line, code, says) -> None:
    got, out, err = vlatool("telemetry", *line)
    assert (got, out) == (code, "")
    assert says in err
