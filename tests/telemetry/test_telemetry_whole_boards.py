from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from telemetry_boards import (
    AGX_ORIN,
    AGX_THOR,
    HWMON,
    NEVER_S,
    NUC,
    ORIN_NANO,
    PI,
    PI5_PMIC,
    PI5_WATTS,
    RAPL,
    VM,
    Clock,
    commands,
    pi,
    reasons,
    write,
)

from vlatool.telemetry import Recorder, Summary, open_all

ANSWERS = {"-q": "NV Power Mode: 25W\n1\n"}


def recorded_between(root: Path, later: dict[str, Any], answers: dict[str, str | None] | None = None) -> Summary:
    """Record a board for ten seconds, during which its files change."""
    clock = Clock()
    with Recorder(
        open_all(write(root, {**VM, **later.pop("board")}), commands(answers or {})), NEVER_S, clock
    ) as found:
        clock.now += 10.0
        write(root, later)
    return found.summary


def test_a_virtual_machine_has_its_process_and_nothing_else(tmp_path: Path) -> None:
    found = recorded_between(tmp_path, {"board": {}})
    assert {name.partition(".")[0] for name in (*found.gauges, *found.counters)} == {"process"}
    assert found.throttled is None
    assert found.energy == ()
    assert {"rapl", "ina", "tegrastats", "vcgencmd", "nvml", "thermal", "cpufreq", "energy"} <= {*reasons(found)}
    assert all(len(text) > 20 for text in reasons(found).values())


def test_an_orin_nano_as_a_whole(tmp_path: Path) -> None:
    later = {"board": ORIN_NANO, f"{HWMON}/hwmon1/curr1_input": 3000, f"{HWMON}/hwmon2/oc3_event_cnt": 5}
    found = recorded_between(tmp_path, later, {**ANSWERS})
    (one,) = found.energy
    assert one.joules == pytest.approx((5.04 + 15.12) / 2 * 10)
    assert one.mean_w == pytest.approx(10.08)
    assert (found.throttled, found.throttling) == (True, ("over-current alarm OC3 (3 more)",))
    assert found.gauges["nvpmodel.mode"].note == "25W"
    assert "tegrastats" not in reasons(found), "the INA monitors are read, so it is not needed"


def test_tegrastats_stands_in_where_the_monitors_are_hidden(tmp_path: Path) -> None:
    lines = iter(["VDD_IN 5000mW/5000mW", "VDD_IN 5000mW/5000mW", "VDD_IN 7000mW/6000mW"])
    clock = Clock()
    readers = open_all(write(tmp_path, VM), lambda command: next(lines) if command[0] == "sh" else None)
    with Recorder(readers, NEVER_S, clock) as found:
        clock.now += 2.0
    assert found.summary.energy[0].joules == pytest.approx(12.0)
    assert "ina" in reasons(found.summary)


def test_an_agx_orin_as_a_whole(tmp_path: Path) -> None:
    (one,) = recorded_between(tmp_path, {"board": AGX_ORIN}).energy
    assert (one.label, one.mean_w) == ("module sum", pytest.approx(9.0))


def test_an_agx_thor_as_a_whole(tmp_path: Path) -> None:
    (one,) = recorded_between(tmp_path, {"board": AGX_THOR}).energy
    assert (one.label, one.mean_w) == ("board input VIN", pytest.approx(27.422))


def test_a_nuc_as_a_whole(tmp_path: Path) -> None:
    later = {
        "board": NUC,
        f"{RAPL}/intel-rapl:0/energy_uj": 162_000_000,
        "sys/devices/system/cpu/cpu1/thermal_throttle/package_throttle_count": 6,
    }
    found = recorded_between(tmp_path, later)
    (one,) = found.energy
    assert (one.joules, one.mean_w) == (pytest.approx(150.0), pytest.approx(15.0))
    assert found.throttling == ("package thermal throttling (1 more)",)
    assert found.gauges["cpufreq.policy0"].max == pytest.approx(4700.123)


def test_a_nuc_whose_counter_wraps_during_the_run(tmp_path: Path) -> None:
    start = {**NUC, f"{RAPL}/intel-rapl:0/energy_uj": 262_143_000_000}
    found = recorded_between(tmp_path, {"board": start, f"{RAPL}/intel-rapl:0/energy_uj": 671_150})
    assert found.energy[0].joules == pytest.approx(1.0)


def test_a_pi_4_has_throttling_and_no_power(tmp_path: Path) -> None:
    found = recorded_between(tmp_path, {"board": PI}, pi("0x50000"))
    assert found.energy == ()
    assert found.throttled is False
    assert "before the recording" in reasons(found)["vcgencmd since start"]
    assert "Raspberry Pi 4" in reasons(found)["vcgencmd power"]


def test_a_pi_5_that_sagged_between_the_samples(tmp_path: Path) -> None:
    clock, answers = Clock(), pi(pmic=PI5_PMIC)
    with Recorder(open_all(write(tmp_path, {**PI, **VM}), commands(answers)), NEVER_S, clock) as found:
        clock.now += 10.0
        answers["get_throttled"] = "throttled=0x10000\n"
    (one,) = found.summary.energy
    assert (one.label, one.mean_w) == ("PMIC rails, without USB", pytest.approx(PI5_WATTS))
    assert found.summary.throttling == ("under-voltage (1 more)",)


def test_a_summary_holds_only_json_numbers(tmp_path: Path) -> None:
    found = recorded_between(tmp_path, {"board": {**ORIN_NANO, **NUC}})
    json.dumps(asdict(found), allow_nan=False)
