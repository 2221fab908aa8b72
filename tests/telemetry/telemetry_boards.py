"""Trees and tool outputs of the boards, as recorded, cut to what is read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlatool.telemetry import Absent, Reader, Reading, Summary

Files = Mapping[str, Any]
HWMON = "sys/class/hwmon"
ZONES = "sys/class/thermal"
CPUS = "sys/devices/system/cpu"
RAPL = "sys/class/powercap"
PI5_PMIC = """\
 3V7_WL_SW_A current(0)=0.09466522A
   3V3_SYS_A current(1)=0.08197812A
  VDD_CORE_A current(7)=1.11625000A
   0V8_AON_A current(16)=0.00274725A
   3V3_DAC_A current(17)=0.00000000A
 3V7_WL_SW_V volt(8)=3.62925200V
   3V3_SYS_V volt(9)=3.31652900V
  VDD_CORE_V volt(15)=0.74944980V
   0V8_AON_V volt(19)=0.79794790V
   3V3_DAC_V volt(20)=3.31043600V
     EXT5V_V volt(24)=5.08530000V
      BATT_V volt(25)=nanV
"""
PI5_WATTS = 0.09466522 * 3.629252 + 0.08197812 * 3.316529 + 1.11625 * 0.7494498 + 0.00274725 * 0.7979479
NEVER_S = 3600.0
"""A period in which the thread does not wake: only the first and the last sample are taken."""
NO_COMMAND = 'error=1 error_msg="Command not registered"\n'


def write(root: Path, files: Files) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    return root


def unreadable(root: Path, *names: str) -> Path:
    """Put directories in the place of files: root reads any file, but no directory."""
    for name in names:
        path = root / name
        if path.is_file():
            path.unlink()
        path.mkdir(parents=True, exist_ok=True)
    return root


def ina3221(place: str, rails: Sequence[tuple[str, int, int]]) -> dict[str, Any]:
    """One chip: label, mV and mA of its three channels, and the sum of the shunt voltages."""
    files: dict[str, Any] = {f"{place}/name": "ina3221", f"{place}/in7_label": "sum of shunt voltages"}
    files[f"{place}/in7_input"] = 4960
    for channel, (label, millivolts, milliamperes) in enumerate(rails, 1):
        files |= {
            f"{place}/in{channel}_label": label,
            f"{place}/in{channel}_input": millivolts,
            f"{place}/curr{channel}_input": milliamperes,
            f"{place}/curr{channel}_crit": 5000,
        }
    return files


def zones(**temperatures: Any) -> dict[str, Any]:
    files: dict[str, Any] = {}
    for index, (kind, temperature) in enumerate(temperatures.items()):
        files[f"{ZONES}/thermal_zone{index}/type"] = kind.replace("_", "-")
        files[f"{ZONES}/thermal_zone{index}/temp"] = temperature
    return files


ORIN_NANO: Files = {
    "proc/device-tree/model": "NVIDIA Jetson Orin Nano Developer Kit\0",
    f"{HWMON}/hwmon0/name": "pwmfan",
    **ina3221(f"{HWMON}/hwmon1", [("VDD_IN", 5040, 1000), ("VDD_CPU_GPU_CV", 5032, 200), ("VDD_SOC", 5032, 400)]),
    f"{HWMON}/hwmon2/name": "soctherm_oc",
    f"{HWMON}/hwmon2/oc1_event_cnt": 0,
    f"{HWMON}/hwmon2/oc2_event_cnt": 0,
    f"{HWMON}/hwmon2/oc3_event_cnt": 2,
    f"{HWMON}/hwmon2/oc3_throt_en": 1,
    **zones(cpu_thermal=48562, gpu_thermal=49625, cv0_thermal=-256000, tj_thermal=49312),
    "sys/class/devfreq/17000000.gpu/cur_freq": 624750000,
    "sys/class/devfreq/17000000.gpu/device/load": 873,
    "sys/class/devfreq/15340000.vic/cur_freq": 115200000,
    f"{CPUS}/cpufreq/policy0/scaling_cur_freq": 1497600,
    f"{CPUS}/cpufreq/policy4/scaling_cur_freq": 729600,
}
AGX_ORIN: Files = {
    "proc/device-tree/model": "NVIDIA Jetson AGX Orin Developer Kit\0",
    **ina3221(f"{HWMON}/hwmon3", [("VDD_GPU_SOC", 20000, 120), ("VDD_CPU_CV", 20000, 80), ("VIN_SYS_5V0", 5000, 940)]),
    **ina3221(f"{HWMON}/hwmon4", [("NC", 0, 0), ("VDDQ_VDD2_1V8AO", 5000, 60), ("NC", 0, 0)]),
    "sys/class/devfreq/17000000.ga10b/cur_freq": 1300500000,
    "sys/class/devfreq/17000000.ga10b/device/load": 1000,
}
AGX_THOR: Files = {
    "proc/device-tree/model": "NVIDIA Jetson AGX Thor Developer Kit\0",
    **ina3221(
        f"{HWMON}/hwmon5", [("VDD_GPU", 12000, 395), ("VDD_CPU_SOC_MSS", 12000, 543), ("VIN_SYS_5V0", 5000, 1304)]
    ),
    f"{HWMON}/hwmon6/name": "ina238",
    f"{HWMON}/hwmon6/in1_input": 19800,
    f"{HWMON}/hwmon6/power1_input": 27422000,
    "sys/class/devfreq/gpu-gpc-0/cur_freq": 1575000000,
    "sys/class/devfreq/gpu-gpc-0/device/load": 250,
    "sys/class/power_supply/ucsi-source-psy-0/voltage_now": 20000000,
}
NUC: Files = {
    f"{RAPL}/intel-rapl:0/name": "package-0",
    f"{RAPL}/intel-rapl:0/energy_uj": 12_000_000,
    f"{RAPL}/intel-rapl:0/max_energy_range_uj": 262_143_328_850,
    f"{RAPL}/intel-rapl:0:0/name": "core",
    f"{RAPL}/intel-rapl:0:0/energy_uj": 7_000_000,
    f"{RAPL}/intel-rapl:1/name": "psys",
    f"{RAPL}/intel-rapl:1/energy_uj": 99_000_000,
    f"{RAPL}/intel-rapl-mmio:0/name": "package-0",
    f"{RAPL}/intel-rapl-mmio:0/energy_uj": 12_000_000,
    f"{ZONES}/thermal_zone0/type": "INT3400 Thermal",
    f"{ZONES}/thermal_zone0/temp": 20000,
    f"{ZONES}/thermal_zone1/type": "acpitz",
    f"{ZONES}/thermal_zone1/temp": 27800,
    f"{ZONES}/thermal_zone2/type": "acpitz",
    f"{ZONES}/thermal_zone2/temp": 29800,
    f"{ZONES}/thermal_zone10/type": "x86_pkg_temp",
    f"{ZONES}/thermal_zone10/temp": 61000,
    f"{CPUS}/cpufreq/policy0/scaling_cur_freq": 4700123,
    f"{CPUS}/cpu0/thermal_throttle/core_throttle_count": 3,
    f"{CPUS}/cpu0/thermal_throttle/package_throttle_count": 5,
    f"{CPUS}/cpu0/thermal_throttle/core_throttle_total_time_ms": 12,
    f"{CPUS}/cpu1/thermal_throttle/core_throttle_count": 1,
    f"{CPUS}/cpu1/thermal_throttle/package_throttle_count": 5,
}
PI: Files = {**zones(cpu_thermal=48123), f"{CPUS}/cpufreq/policy0/scaling_cur_freq": 2400000}
VM: Files = {
    "proc/stat": "cpu  100 0 50 1000 5 0 2 250 0 0\ncpu0 100 0 50 1000 5 0 2 250 0 0\nctxt 5",
    "proc/self/stat": "42 (python (3) x) R 1 42 42 0 -1 4194304 900 0 0 0 250 50 0 0 20 0 3 0 100 5000 600",
    "proc/self/status": "Name:\tpython\nVmRSS:\t  250000 kB\nnonvoluntary_ctxt_switches:\t7",
    "proc/self/task/42/status": "voluntary_ctxt_switches:\t100\nnonvoluntary_ctxt_switches:\t7",
    "proc/self/task/43/status": "voluntary_ctxt_switches:\t100\nnonvoluntary_ctxt_switches:\t5",
}


def commands(answers: Mapping[str, str | None]) -> Callable[[Sequence[str]], str | None]:
    """Run nothing: answer by the last word of the command."""
    return lambda command: answers.get(command[-1])


def pi(throttled: str = "0x0", degrees: str = "48.0", pmic: str | None = None) -> dict[str, str | None]:
    return {
        "get_throttled": f"throttled={throttled}\n",
        "measure_temp": f"temp={degrees}'C\n",
        "pmic_read_adc": pmic,
    }


def values(readings: Iterable[Reading]) -> dict[str, float]:
    return {reading.name: reading.value for reading in readings}


def read(found: Reader | Absent) -> dict[str, float]:
    assert isinstance(found, Reader), found
    return values(found.read())


def reason(found: Reader | Absent) -> str:
    assert isinstance(found, Absent), found
    return found.reason


def reasons(found: Summary) -> dict[str, str]:
    return {one.reader: one.reason for one in found.unmeasured}


class Clock:
    """Seconds that pass only when the test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now
