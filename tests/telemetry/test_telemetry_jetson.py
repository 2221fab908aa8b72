from __future__ import annotations

from pathlib import Path

import pytest
from telemetry_boards import (
    AGX_ORIN,
    AGX_THOR,
    HWMON,
    ORIN_NANO,
    PI,
    VM,
    commands,
    ina3221,
    read,
    reason,
    unreadable,
    values,
    write,
)

from vlatool.telemetry import Reading, devfreq, nvpmodel, tegrastats, totals
from vlatool.telemetry.devfreq import DevfreqReader
from vlatool.telemetry.ina import InaReader
from vlatool.telemetry.nvpmodel import NvpmodelReader
from vlatool.telemetry.overcurrent import OvercurrentReader
from vlatool.telemetry.tegrastats import TegrastatsReader

NANO = (
    "RAM 2594/3956MB (lfb 12x4MB) SWAP 0/1978MB (cached 0MB) IRAM 0/252kB(lfb 252kB) "
    "CPU [12%@102,off,10%@1479,off] EMC_FREQ 3%@1600 GR3D_FREQ 16%@76 APE 25 PLL@36.5C CPU@39C "
    "iwlwifi@44C PMIC@100C GPU@37C AO@47.5C thermal@38C POM_5V_IN 2247/2189 POM_5V_GPU 78/78 POM_5V_CPU 275/275"
)
ORIN_JP5 = (
    "01-03-2023 16:10:22 RAM 2257/30536MB (lfb 5392x4MB) SWAP 0/15268MB (cached 0MB) "
    "CPU [3%@729,0%@729,off,off] EMC_FREQ 0% GR3D_FREQ 14%@[407,407] VIC_FREQ 729 APE 174 CV0@-256C CPU@41.375C "
    "Tboard@29C SOC2@39C tj@41.468C VDD_GPU_SOC 3150mW/2971mW VDD_CPU_CV 788mW/788mW VIN_SYS_5V0 4440mW/4440mW "
    "NC 0mW/0mW VDDQ_VDD2_1V8AO 403mW/403mW NC 0mW/0mW"
)
ORIN_JP6 = (
    "05-09-2026 18:42:06 RAM 18207/62841MB (lfb 466x4MB) SWAP 86/31420MB (cached 0MB) CPU [14%@2188,47%@1267] "
    "EMC_FREQ 3%@2133 GR3D_FREQ 0%@[0,0] NVENC 79%@166 NVDEC off NVJPG1 off VIC 36%@115 OFA off PVA0_FREQ off APE 174 "
    "cpu@52.562C soc2@48.437C tj@52.562C VDD_GPU_SOC 2412mW/2412mW VDD_CPU_CV 1607mW/1607mW VIN_SYS_5V0 4707mW/4707mW"
)
ORIN_NANO_LINE = (
    "10-08-2026 04:35:02 RAM 6712/7620MB (lfb 12x4MB) SWAP 369/3810MB (cached 8MB) CPU [38%@1497,2%@729] "
    "EMC_FREQ 61%@2133 GR3D_FREQ 99%@[612] NVDEC off APE 200 cpu@57.125C gpu@58.625C tj@58.312C "
    "VDD_IN 16321mW/11204mW VDD_CPU_GPU_CV 7104mW/4944mW VDD_SOC 3120mW/3659mW"
)


def label(readings: list[Reading]) -> str:
    return "; ".join(total.label for total in totals(readings))


def test_the_rails_of_an_orin_nano_are_volts_times_amperes(tmp_path: Path) -> None:
    found = InaReader.open(write(tmp_path, ORIN_NANO))
    assert read(found) == pytest.approx({"ina.VDD_IN": 5.04, "ina.VDD_CPU_GPU_CV": 1.0064, "ina.VDD_SOC": 2.0128})


def test_vdd_in_is_the_total_and_the_other_rails_are_not_added(tmp_path: Path) -> None:
    found = InaReader.open(write(tmp_path, ORIN_NANO))
    assert isinstance(found, InaReader)
    (total,) = totals(found.read())
    assert (total.names, total.unit) == (("ina.VDD_IN",), "W")
    assert "without the carrier board" in total.label


def test_an_agx_orin_has_no_input_rail_and_its_sum_says_so(tmp_path: Path) -> None:
    found = InaReader.open(write(tmp_path, AGX_ORIN))
    assert isinstance(found, InaReader)
    readings = found.read()
    (total,) = totals(readings)
    assert total.label == "module sum"
    watts = values(readings)
    assert sum(watts[name] for name in total.names) == pytest.approx(2.4 + 1.6 + 4.7 + 0.3)
    assert not any("NC" in name or "sum of" in name for name in watts)


def test_a_module_sum_names_the_rail_that_is_missing(tmp_path: Path) -> None:
    files = {name: text for name, text in AGX_ORIN.items() if "hwmon4" not in name}
    found = InaReader.open(write(tmp_path, files))
    assert isinstance(found, InaReader)
    assert label(found.read()) == "module sum, without VDDQ_VDD2_1V8AO"


def test_the_total_of_an_agx_thor_is_vin_of_its_ina238_in_microwatts(tmp_path: Path) -> None:
    found = InaReader.open(write(tmp_path, AGX_THOR))
    watts = read(found)
    assert watts["ina.VIN"] == pytest.approx(27.422)
    assert isinstance(found, InaReader)
    (total,) = totals(found.read())
    assert (total.names, total.label) == (("ina.VIN",), "board input VIN")


@pytest.mark.parametrize("name", ["label", "in1_label", "power1_label"])
def test_an_ina238_takes_its_label_where_it_has_one(tmp_path: Path, name: str) -> None:
    root = write(tmp_path, {f"{HWMON}/hwmon0/name": "ina238", f"{HWMON}/hwmon0/power1_input": 1500000})
    assert read(InaReader.open(root)) == {"ina.INA238": 1.5}
    write(root, {f"{HWMON}/hwmon0/{name}": "VIN"})
    assert read(InaReader.open(root)) == {"ina.VIN": 1.5}


def test_an_ina238_without_label_on_another_board_is_no_total(tmp_path: Path) -> None:
    root = write(tmp_path, {f"{HWMON}/hwmon0/name": "ina238", f"{HWMON}/hwmon0/power1_input": 1500000})
    found = InaReader.open(root)
    assert isinstance(found, InaReader)
    assert totals(found.read()) == []


def test_usb_c_supplies_are_no_rails(tmp_path: Path) -> None:
    assert not any("ucsi" in name for name in read(InaReader.open(write(tmp_path, AGX_THOR))))


def test_the_path_of_the_driver_is_read_where_the_class_is_hidden(tmp_path: Path) -> None:
    place = "sys/bus/i2c/drivers/ina3221/1-0040/hwmon/hwmon1"
    root = write(tmp_path, ina3221(place, [("VDD_IN", 5000, 2000)]))
    assert read(InaReader.open(root)) == {"ina.VDD_IN": 10.0}


def test_a_chip_that_shows_in_both_places_is_read_once(tmp_path: Path) -> None:
    place = "sys/bus/i2c/drivers/ina3221/1-0040/hwmon/hwmon1"
    root = write(tmp_path, {**ORIN_NANO, **ina3221(place, [("VDD_IN", 5000, 2000)])})
    assert len(read(InaReader.open(root))) == 3


def test_the_rails_of_jetpack_4_are_milliwatts(tmp_path: Path) -> None:
    place = "sys/bus/i2c/drivers/ina3221x/6-0040/iio:device0"
    files = {
        f"{place}/rail_name_0": "POM_5V_IN",
        f"{place}/in_power0_input": 2247,
        f"{place}/rail_name_1": "POM_5V_GPU",
        f"{place}/in_power1_input": 78,
        f"{place}/rail_name_2": "NC",
        f"{place}/in_power2_input": 0,
    }
    found = InaReader.open(write(tmp_path, files))
    assert read(found) == pytest.approx({"ina.POM_5V_IN": 2.247, "ina.POM_5V_GPU": 0.078})
    assert isinstance(found, InaReader)
    assert label(found.read()) == "board input POM_5V_IN"


def test_a_rail_that_fails_later_is_left_out(tmp_path: Path) -> None:
    root = write(tmp_path, ORIN_NANO)
    found = InaReader.open(root)
    unreadable(root, f"{HWMON}/hwmon1/curr1_input")
    write(root, {f"{HWMON}/hwmon1/in2_input": "garbage"})
    assert read(found) == pytest.approx({"ina.VDD_SOC": 2.0128})


def test_a_current_below_zero_stays_below_zero(tmp_path: Path) -> None:
    root = write(tmp_path, ina3221(f"{HWMON}/hwmon1", [("VDD_GPU", 12000, -32)]))
    assert read(InaReader.open(root)) == pytest.approx({"ina.VDD_GPU": -0.384})


def test_the_same_label_on_two_chips_gets_an_index(tmp_path: Path) -> None:
    files = {
        **ina3221(f"{HWMON}/hwmon2", [("VDD", 1000, 1000)]),
        **ina3221(f"{HWMON}/hwmon10", [("VDD", 1000, 2000)]),
    }
    assert read(InaReader.open(write(tmp_path, files))) == {"ina.VDD": 1.0, "ina.VDD-1": 2.0}


def test_rails_that_are_not_known_to_be_a_whole_give_no_total(tmp_path: Path) -> None:
    found = InaReader.open(write(tmp_path, ina3221(f"{HWMON}/hwmon1", [("VDD_SRAM", 1000, 1000)])))
    assert isinstance(found, InaReader)
    assert totals(found.read()) == []


def test_a_board_without_monitors_says_how_to_measure(tmp_path: Path) -> None:
    assert "measure at the supply" in reason(InaReader.open(write(tmp_path, PI)))


def test_monitors_that_cannot_be_read_are_told_from_none(tmp_path: Path) -> None:
    root = write(tmp_path, ina3221(f"{HWMON}/hwmon1", [("VDD_IN", 5000, 2000)]))
    unreadable(root, f"{HWMON}/hwmon1/curr1_input")
    assert "none of their rails" in reason(InaReader.open(root))


@pytest.mark.parametrize(
    ("board", "load", "clock"), [(ORIN_NANO, 0.873, 624.75), (AGX_ORIN, 1.0, 1300.5), (AGX_THOR, 0.25, 1575.0)]
)
def test_gpu_load_is_a_share_and_its_clock_is_in_mhz(
    tmp_path: Path, board: dict[str, str], load: float, clock: float
) -> None:
    found = read(DevfreqReader.open(write(tmp_path, board)))
    assert found == pytest.approx({"devfreq.gpu.load": load, "devfreq.gpu.clock": clock})


@pytest.mark.parametrize("name", ["57000000.gpu", "17000000.gv11b", "17000000.gp10b", "gpu-gpc-0"])
def test_the_names_of_gpus(name: str) -> None:
    assert devfreq.GPU.search(name)
    assert not devfreq.GPU.search("15340000.vic")


def test_a_gpu_that_is_powered_off_gives_its_clock_alone(tmp_path: Path) -> None:
    root = write(tmp_path, ORIN_NANO)
    found = DevfreqReader.open(root)
    unreadable(root, "sys/class/devfreq/17000000.gpu/device/load")
    assert [*read(found)] == ["devfreq.gpu.clock"]
    assert "not a Jetson" in reason(DevfreqReader.open(tmp_path / "none"))


def test_overcurrent_events_are_throttle_counters(tmp_path: Path) -> None:
    found = OvercurrentReader.open(write(tmp_path, ORIN_NANO))
    assert read(found) == {"overcurrent.oc1": 0, "overcurrent.oc2": 0, "overcurrent.oc3": 2}
    assert isinstance(found, OvercurrentReader)
    assert {(one.kind, one.unit) for one in found.read()} == {("counter", "throttle")}
    assert "not a Jetson" in reason(OvercurrentReader.open(tmp_path / "none"))


def test_a_line_of_jetpack_4_without_date_and_without_milliwatts() -> None:
    found = values(tegrastats.parse(NANO))
    assert found["tegrastats.POM_5V_IN"] == 2.247
    assert found["tegrastats.cpu0.load"] == 0.12
    assert found["tegrastats.cpu2.clock"] == 1479
    assert "tegrastats.cpu1.load" not in found, "a core that is off has no load, not 0"
    assert (found["tegrastats.GR3D.load"], found["tegrastats.GR3D.clock"]) == (0.16, 76)
    assert found["tegrastats.AO.temperature"] == 47.5
    assert not any("PMIC" in name or name in ("tegrastats.RAM/", "tegrastats.SWAP") for name in found)
    assert label(tegrastats.parse(NANO)) == "board input POM_5V_IN"


def test_a_line_of_jetpack_5_with_date_array_of_clocks_and_zones_that_are_off() -> None:
    found = values(tegrastats.parse(ORIN_JP5))
    assert found["tegrastats.VDD_GPU_SOC"] == 3.15, "now, not the average"
    assert (found["tegrastats.GR3D.clock0"], found["tegrastats.GR3D.clock1"]) == (407, 407)
    assert found["tegrastats.EMC.load"] == 0
    assert "tegrastats.EMC.clock" not in found
    assert found["tegrastats.VIC.clock"] == 729
    assert found["tegrastats.tj.temperature"] == 41.468
    assert found["tegrastats.RAM"] == pytest.approx(2257 * 1.048576)
    assert not any("CV0" in name or ".NC" in name for name in found)
    assert label(tegrastats.parse(ORIN_JP5)) == "module sum"


def test_a_line_of_jetpack_6_with_engines_and_small_letters() -> None:
    found = values(tegrastats.parse(ORIN_JP6))
    assert (found["tegrastats.NVENC.load"], found["tegrastats.NVENC.clock"]) == (0.79, 166)
    assert found["tegrastats.cpu.temperature"] == 52.562
    assert not any("NVDEC" in name or "PVA0" in name for name in found)
    assert label(tegrastats.parse(ORIN_JP6)) == "module sum, without VDDQ_VDD2_1V8AO"


def test_a_line_of_an_orin_nano() -> None:
    readings = tegrastats.parse(ORIN_NANO_LINE)
    assert values(readings)["tegrastats.GR3D.clock"] == 612
    assert totals(readings)[0].names == ("tegrastats.VDD_IN",)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("GPU@-5.5C", {"tegrastats.GPU.temperature": -5.5}),
        ("GPU@-256C", {}),
        ("VDD_GPU -392mW/0mW", {"tegrastats.VDD_GPU": -0.392}),
        ("VDD_IN 2532mW", {}),
        ("EMC_MAX_FREQ 7%@1600", {"tegrastats.EMC.load": 0.07, "tegrastats.EMC.max_clock": 1600}),
        ("GR3D_MAX_FREQ 1300", {"tegrastats.GR3D.max_clock": 1300}),
        ("CPU [5%,off]@1190", {"tegrastats.cpu0.load": 0.05, "tegrastats.cpu0.clock": 1190}),
        ("CPU [off,off]", {}),
        ("RAM 2/4GB", {"tegrastats.RAM": 2147.483648}),
        ("GPU 500mW/400mW GPU@40C", {"tegrastats.GPU": 0.5, "tegrastats.GPU.temperature": 40}),
        ("", {}),
        ("\0\x7f garbage [[[%@%@ CPU [ @@C VDD 1/", {}),
    ],
)
def test_forms_of_a_line(text: str, expected: dict[str, float]) -> None:
    assert values(tegrastats.parse(text)) == pytest.approx(expected)


def test_tegrastats_is_asked_for_one_line_and_may_fall_silent() -> None:
    answers: dict[str, str | None] = {tegrastats.COMMAND[-1]: ORIN_NANO_LINE}
    found = TegrastatsReader.open(run=commands(answers))
    assert read(found)["tegrastats.VDD_IN"] == 16.321
    answers.clear()
    assert read(found) == {}
    assert "prints nothing" in reason(TegrastatsReader.open(run=commands({})))


@pytest.mark.parametrize(
    ("text", "mode"),
    [
        ("NV Power Mode: MAXN\n0\n", ("MAXN", 0)),
        ("NV Power Mode: 25W\n1\n", ("25W", 1)),
        ("NVPM WARN: fan mode is not set!\nNV Power Mode: MODE_15W_6CORE\r\n2\r\n", ("MODE_15W_6CORE", 2)),
        ("NV Power Mode: MAXN SUPER \n 2\n", ("MAXN SUPER", 2)),
        ("NV Power Mode: 25W\n", None),
        ("NVPM ERROR: Error opening /var/lib/nvpmodel/status: 13\n", None),
        ("", None),
    ],
)
def test_power_modes(text: str, mode: tuple[str, int] | None) -> None:
    assert nvpmodel.parse(text) == mode


def test_the_power_mode_is_a_number_with_its_name() -> None:
    found = NvpmodelReader.open(run=commands({"-q": "NV Power Mode: 25W\n1\n"}))
    assert isinstance(found, NvpmodelReader)
    (mode,) = found.read()
    assert (mode.name, mode.value, mode.note) == ("nvpmodel.mode", 1, "25W")
    assert "sudo" in reason(NvpmodelReader.open(run=commands({})))


def test_a_copied_tree_runs_no_command_here(tmp_path: Path) -> None:
    root = write(tmp_path, VM)
    assert "no mode" in reason(NvpmodelReader.open(root))
    assert "prints nothing" in reason(TegrastatsReader.open(root))
