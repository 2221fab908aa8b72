"""Temperatures of the thermal zones.

Source: ``Documentation/driver-api/thermal/sysfs-api.rst`` of Linux (``temp`` in 0.001 degC).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from vlatool.machine.host import ROOT, read_text
from vlatool.telemetry._reading import DEGREE, MIN_TEMPERATURE, Absent, FileReader, NumberFile, Run, find

NO_SENSORS = ("PMIC", "INT3400")
"""Zones without a sensor: the PMIC of a Jetson shows 50 or 100 degC always, ``INT3400 Thermal`` of Intel 20 degC."""


class ThermalReader(FileReader):
    """Temperature of every zone in degC, as ``thermal.TYPE``; the second zone of a type is ``thermal.TYPE-1``."""

    name = "thermal"

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> ThermalReader | Absent:
        """Find the zones; absent where none shows a temperature."""
        files = []
        counts: Counter[str] = Counter()
        for folder in find(root, "sys/class/thermal", "thermal_zone*"):
            kind = read_text(root, f"{folder}/type")
            if kind is None or any(word in kind.upper() for word in NO_SENSORS):
                continue
            name = f"thermal.{kind}-{counts[kind]}" if counts[kind] else f"thermal.{kind}"
            files.append(NumberFile(name, f"{folder}/temp", 1e-3, DEGREE, minimum=MIN_TEMPERATURE))
            counts[kind] += 1
        return cls(root, files).or_absent(
            "no thermal zone shows a temperature (virtual machine or container)", other_board=True
        )
