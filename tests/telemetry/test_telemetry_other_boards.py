from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import pytest
from telemetry_boards import (
    AGX_ORIN,
    CPUS,
    NO_COMMAND,
    NUC,
    ORIN_NANO,
    PI,
    PI5_PMIC,
    PI5_WATTS,
    RAPL,
    VM,
    ZONES,
    commands,
    pi,
    read,
    reason,
    unreadable,
    values,
    write,
)

from vlatool.machine import host
from vlatool.telemetry import totals, vcgencmd
from vlatool.telemetry.cpufreq import CpufreqReader
from vlatool.telemetry.process import ProcessReader
from vlatool.telemetry.rapl import RaplReader
from vlatool.telemetry.thermal import ThermalReader
from vlatool.telemetry.vcgencmd import VcgencmdReader


def test_rapl_reads_the_package_alone(tmp_path: Path) -> None:
    found = RaplReader.open(write(tmp_path, NUC))
    assert isinstance(found, RaplReader)
    (package,) = found.read()
    assert (package.name, package.value, package.unit, package.kind) == ("rapl.package-0", 12.0, "J", "counter")
    assert package.wraps == pytest.approx(262143.32885)
    (total,) = totals([package])
    assert total.label == "package, without the board"


def test_two_packages_are_added(tmp_path: Path) -> None:
    files = {f"{RAPL}/intel-rapl:2/name": "package-1", f"{RAPL}/intel-rapl:2/energy_uj": 5_000_000}
    found = RaplReader.open(write(tmp_path, {**NUC, **files}))
    assert read(found) == {"rapl.package-0": 12.0, "rapl.package-1": 5.0}
    assert isinstance(found, RaplReader)
    (total,) = totals(found.read())
    assert total.label == "2 packages, without the board"


def test_a_counter_that_only_root_may_read_names_the_udev_rule(tmp_path: Path) -> None:
    root = unreadable(write(tmp_path, NUC), f"{RAPL}/intel-rapl:0/energy_uj")
    told = reason(RaplReader.open(root))
    assert 'SUBSYSTEM=="powercap", KERNEL=="intel-rapl*"' in told
    assert "chmod g+r" in told


def test_one_locked_package_of_two_is_no_measurement(tmp_path: Path) -> None:
    root = write(tmp_path, {**NUC, f"{RAPL}/intel-rapl:2/name": "package-1"})
    unreadable(root, f"{RAPL}/intel-rapl:2/energy_uj")
    assert "only root may" in reason(RaplReader.open(root))


def test_a_counter_that_vanishes_gives_nothing(tmp_path: Path) -> None:
    root = write(tmp_path, NUC)
    found = RaplReader.open(root)
    (root / RAPL / "intel-rapl:0/energy_uj").unlink()
    assert read(found) == {}


def test_no_rapl_says_how_to_measure(tmp_path: Path) -> None:
    assert "at the wall" in reason(RaplReader.open(write(tmp_path, VM)))


def test_zones_have_numbers_for_equal_types_and_fixed_ones_are_skipped(tmp_path: Path) -> None:
    found = read(ThermalReader.open(write(tmp_path, NUC)))
    assert found == {"thermal.acpitz": 27.8, "thermal.acpitz-1": 29.8, "thermal.x86_pkg_temp": 61.0}


def test_zones_that_are_powered_off_are_skipped(tmp_path: Path) -> None:
    root = write(tmp_path, ORIN_NANO)
    write(root, {f"{ZONES}/thermal_zone9/type": "PMIC-Die", f"{ZONES}/thermal_zone9/temp": 100000})
    found = ThermalReader.open(root)
    assert [*read(found)] == ["thermal.cpu-thermal", "thermal.gpu-thermal", "thermal.tj-thermal"]
    unreadable(root, f"{ZONES}/thermal_zone1/temp")
    write(root, {f"{ZONES}/thermal_zone0/temp": "", f"{ZONES}/thermal_zone2/temp": 30000})
    assert read(found) == {"thermal.cv0-thermal": 30.0, "thermal.tj-thermal": 49.312}


def test_a_temperature_below_zero_is_one(tmp_path: Path) -> None:
    root = write(tmp_path, {**PI, f"{ZONES}/thermal_zone0/temp": -12500})
    assert read(ThermalReader.open(root)) == {"thermal.cpu-thermal": -12.5}


def test_no_zone_is_absent(tmp_path: Path) -> None:
    assert "no thermal zone" in reason(ThermalReader.open(write(tmp_path, VM)))
    only_off = {f"{ZONES}/thermal_zone0/type": "CV0-therm", f"{ZONES}/thermal_zone0/temp": -256000}
    assert "no thermal zone" in reason(ThermalReader.open(write(tmp_path, only_off)))


def test_clocks_are_in_mhz_and_throttle_counts_are_added(tmp_path: Path) -> None:
    found = CpufreqReader.open(write(tmp_path, NUC))
    assert read(found) == pytest.approx(
        {"cpufreq.policy0": 4700.123, "cpufreq.core_throttle_count": 4, "cpufreq.package_throttle_count": 10}
    )
    assert isinstance(found, CpufreqReader)
    assert found.absent() == []


def test_a_core_that_goes_off_takes_no_throttle_events_away(tmp_path: Path) -> None:
    root = write(tmp_path, NUC)
    found = CpufreqReader.open(root)
    (root / CPUS / "cpu0/thermal_throttle/core_throttle_count").unlink()
    assert read(found)["cpufreq.core_throttle_count"] == 4
    assert read(CpufreqReader.open(root))["cpufreq.core_throttle_count"] == 1, "a new reader sees one core"


def test_a_processor_without_throttle_counters_says_so(tmp_path: Path) -> None:
    found = CpufreqReader.open(write(tmp_path, AGX_ORIN | PI))
    assert read(found) == {"cpufreq.policy0": 2400.0}
    assert isinstance(found, CpufreqReader)
    (missing,) = found.absent()
    assert "Intel's" in missing.reason
    assert "virtual machine" in reason(CpufreqReader.open(tmp_path / "none"))


@pytest.mark.parametrize(
    ("text", "bits"),
    [
        ("throttled=0x0\n", 0),
        ("throttled=0x50005\n", 0x50005),
        ("throttled=0xE0008", 0xE0008),
        ("VCHI initialization failed", None),
        ("throttled=0x", None),
        ("", None),
    ],
)
def test_throttle_bits(text: str, bits: int | None) -> None:
    assert vcgencmd.parse_throttling(text) == bits


@pytest.mark.parametrize(
    ("text", "degrees"), [("temp=48.0'C\n", 48.0), ("temp=-3.2'C", -3.2), ("temp=nan'C", None), ("", None)]
)
def test_temperatures_of_vcgencmd(text: str, degrees: float | None) -> None:
    assert vcgencmd.parse_temperature(text) == degrees


def test_the_rails_of_a_pi_5_are_paired_by_name_and_not_by_number() -> None:
    watts = vcgencmd.parse_pmic_watts(PI5_PMIC)
    assert [*watts] == ["3V7_WL_SW", "3V3_SYS", "VDD_CORE", "0V8_AON", "3V3_DAC"]
    assert sum(watts.values()) == pytest.approx(PI5_WATTS)
    assert watts["VDD_CORE"] == pytest.approx(1.11625 * 0.7494498)


@pytest.mark.parametrize(
    "text",
    [
        "",
        NO_COMMAND,
        " A_A current(1)=nanA\n A_V volt(2)=1.0V\n",
        " A_A current(1)=1.0A\n B_V volt(1)=1.0V\n",
        "A_A=1A",
    ],
)
def test_no_rail_is_made_up(text: str) -> None:
    assert vcgencmd.parse_pmic_watts(text) == {}


def test_a_pi_5_has_rails_and_a_labelled_sum() -> None:
    found = VcgencmdReader.open(run=commands(pi(pmic=PI5_PMIC)))
    assert isinstance(found, VcgencmdReader)
    readings = found.read()
    assert values(readings)["vcgencmd.temperature"] == 48.0
    (total,) = totals(readings)
    assert total.label == "PMIC rails, without USB"
    assert sum(values(readings)[name] for name in total.names) == pytest.approx(PI5_WATTS)
    assert found.absent() == []


@pytest.mark.parametrize("answer", [None, NO_COMMAND])
def test_a_pi_4_has_no_rails_and_says_so(answer: str | None) -> None:
    found = VcgencmdReader.open(run=commands(pi(pmic=answer)))
    assert isinstance(found, VcgencmdReader)
    assert totals(found.read()) == []
    (missing,) = found.absent()
    assert "Raspberry Pi 4" in missing.reason
    assert "at the supply" in missing.reason


def test_bits_of_now_are_flags_and_sticky_bits_are_counters() -> None:
    found = VcgencmdReader.open(run=commands(pi("0x4")))
    assert isinstance(found, VcgencmdReader)
    kinds = {one.name: (one.kind, one.value) for one in found.read() if one.unit == "throttle"}
    assert kinds["vcgencmd.throttled"] == ("gauge", 1)
    assert kinds["vcgencmd.under-voltage"] == ("gauge", 0)
    assert kinds["vcgencmd.throttled_since_start"] == ("counter", 0)
    assert len(kinds) == 8


def test_a_sticky_bit_from_before_tells_nothing_new_and_is_named() -> None:
    found = VcgencmdReader.open(run=commands(pi("0x50000", pmic=PI5_PMIC)))
    assert isinstance(found, VcgencmdReader)
    names = [*values(found.read())]
    assert "vcgencmd.throttled_since_start" not in names
    assert "vcgencmd.arm_frequency_capped_since_start" in names
    (missing,) = found.absent()
    assert missing.reason.startswith("under-voltage, throttled occurred before")


def test_vcgencmd_that_falls_silent_gives_less() -> None:
    answers = pi(pmic=PI5_PMIC)
    found = VcgencmdReader.open(run=commands(answers))
    answers["get_throttled"] = None
    answers["pmic_read_adc"] = "garbage"
    assert read(found) == {"vcgencmd.temperature": 48.0}


def test_no_vcgencmd_names_the_group(tmp_path: Path) -> None:
    assert "usermod -aG video" in reason(VcgencmdReader.open(run=commands({})))
    assert "usermod" in reason(VcgencmdReader.open(tmp_path)), "a copied tree runs no command"


def test_reading_a_file_of_thousands_of_digits_is_absent(tmp_path: Path) -> None:
    for digits in ("9" * 400, "9" * 5000):
        root = write(tmp_path, {**NUC, f"{RAPL}/intel-rapl:0/energy_uj": digits})
        assert "only root may" in reason(RaplReader.open(root))


def test_no_reader_opens_a_file_for_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write(tmp_path, {**NUC, **VM})
    modes: list[str] = []
    real = builtins.open

    def watched(file: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
        modes.append(mode)
        return real(file, mode, *rest, **named)

    monkeypatch.setattr(builtins, "open", watched)
    for reader in (RaplReader, ThermalReader, CpufreqReader, ProcessReader):
        read(reader.open(root))
    assert not any(set(mode) & set("wax+") for mode in modes)
    assert host.read_text(root, f"{RAPL}/intel-rapl:0/energy_uj") == "12000000"
