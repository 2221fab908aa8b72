"""Temperature, throttling and, on a Raspberry Pi 5, the rails of the power controller, from ``vcgencmd``.

Sources: the vcgencmd page of the Raspberry Pi documentation (bits of ``get_throttled``), and recorded output of
``pmic_read_adc``. A Raspberry Pi 4 senses no current.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import DEGREE, THROTTLE, WATT, Absent, Reader, Reading, Run, counter, gauge, runner

BITS = {0: "under-voltage", 1: "arm frequency capped", 2: "throttled", 3: "soft temperature limit"}
"""Current state; the same bits from 16 on tell whether it occurred since the machine started."""
SINCE_START = 16
TEMPERATURE = re.compile(r"temp=(-?\d+(?:\.\d+)?)'C")
THROTTLE_BITS = re.compile(r"throttled=0x([0-9a-fA-F]{1,8})\b")
CURRENT = re.compile(r"^\s*(\w+)_A current\(\d+\)=(\d+(?:\.\d+)?)A\s*$", re.MULTILINE)
VOLTAGE = re.compile(r"^\s*(\w+)_V volt\(\d+\)=(\d+(?:\.\d+)?)V\s*$", re.MULTILINE)
REASON = "vcgencmd fails: this is not a Raspberry Pi, or it needs 'sudo usermod -aG video $USER' and a new login"
NO_CURRENT = "this board does not measure current (e.g. a Raspberry Pi 4): measure its power at the supply"


class VcgencmdReader(Reader):
    """Temperature (degC), throttling now and since the start of the machine, and watts per rail; once a second.

    The rails do not include the power of USB ports and 5 V pins, nor the losses of the converters.
    """

    name = "vcgencmd"
    period_s = 1.0

    def __init__(self, run: Run, has_rails: bool, was_throttled: int) -> None:
        self._run = run
        self._has_rails = has_rails
        self._was_throttled = was_throttled

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> VcgencmdReader | Absent:
        """Ask for every value once; absent without temperature and throttling."""
        ask = runner(root, run)
        bits = parse_throttling(ask(("vcgencmd", "get_throttled")) or "")
        degrees = parse_temperature(ask(("vcgencmd", "measure_temp")) or "")
        if bits is None and degrees is None:
            return Absent(cls.name, REASON, other_board=True)
        rails = parse_pmic_watts(ask(("vcgencmd", "pmic_read_adc")) or "")
        return cls(ask, bool(rails), (bits or 0) >> SINCE_START)

    def read(self) -> list[Reading]:
        """Return the current values."""
        readings = gauge("vcgencmd.temperature", parse_temperature(self._ask("measure_temp")), DEGREE)
        bits = parse_throttling(self._ask("get_throttled"))
        for bit, words in BITS.items() if bits is not None else ():
            name = words.replace(" ", "_")
            readings += gauge(f"vcgencmd.{name}", _bit(bits, bit), THROTTLE, words)
            if not _bit(self._was_throttled, bit):
                sticky = _bit(bits, bit + SINCE_START)
                readings += counter(f"vcgencmd.{name}_since_start", sticky, THROTTLE, note=words)
        if self._has_rails:
            for rail, watts in parse_pmic_watts(self._ask("pmic_read_adc")).items():
                readings += gauge(f"vcgencmd.{rail}", watts, WATT)
        return readings

    def absent(self) -> list[Absent]:
        """Return missing current measurement, and throttle bits that were set before the recording."""
        missing = [] if self._has_rails else [Absent("vcgencmd power", NO_CURRENT)]
        before = [words for bit, words in BITS.items() if _bit(self._was_throttled, bit)]
        if before:
            reason = (
                f"{', '.join(before)} occurred before the recording; these bits stay until a restart, "
                "so a new event between two samples cannot be seen"
            )
            missing.append(Absent("vcgencmd since start", reason))
        return missing

    def _ask(self, command: str) -> str:
        return self._run(("vcgencmd", command)) or ""


def _bit(bits: int | None, bit: int) -> int:
    return (bits or 0) >> bit & 1


def parse_temperature(text: str) -> float | None:
    """Return the degC of ``temp=48.0'C``; None when there is none."""
    degrees = TEMPERATURE.search(text)
    return float(degrees[1]) if degrees else None


def parse_throttling(text: str) -> int | None:
    """Return the bits of ``throttled=0x50000``; None when there are none."""
    bits = THROTTLE_BITS.search(text)
    return int(bits[1], 16) if bits else None


def parse_pmic_watts(text: str) -> dict[str, float]:
    r"""Return the watts of every rail that has both a current and a voltage, paired by name.

    The numbers in brackets are channels of the converter and differ between the two. ``EXT5V`` and ``BATT`` have no
    current; ``nan`` is left out.

    Example:
        >>> pmic_watts(" VDD_CORE_A current(7)=2.0A\n VDD_CORE_V volt(15)=0.75V\n BATT_V volt(25)=nanV\n")
        {'VDD_CORE': 1.5}
    """
    volts = {rail: float(value) for rail, value in VOLTAGE.findall(text)}
    watts = {rail: float(value) * volts[rail] for rail, value in CURRENT.findall(text) if rail in volts}
    return {rail: value for rail, value in watts.items() if math.isfinite(value)}
