"""Temperatures of the thermal zones.

Source: ``Documentation/driver-api/thermal/sysfs-api.rst`` of Linux (``temp`` in 0.001 degC).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from vlatool.machine.host import ROOT, read_text
from vlatool.telemetry._reading import DEGREE, Absent, Reader, Reading, Run, gauge, listed, scaled

COLDEST = -200.0
"""Below this in degC a zone is powered off: Jetsons show -256."""
NO_SENSORS = ("PMIC", "INT3400")
"""Zones without a sensor: the PMIC of a Jetson shows 50 or 100 degC always, ``INT3400 Thermal`` of Intel 20 degC."""


class ThermalReader(Reader):
    """Temperature of every zone in degC, as ``thermal.TYPE``; the second zone of a type is ``thermal.TYPE-1``."""

    name = "thermal"

    def __init__(self, root: Path, zones: dict[str, str]) -> None:
        self._root = root
        self._zones = zones

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> ThermalReader | Absent:
        """Find the zones; absent where none shows a temperature."""
        zones: dict[str, str] = {}
        seen: Counter[str] = Counter()
        for place in listed(root, "sys/class/thermal", "thermal_zone*"):
            kind = read_text(root, f"{place}/type")
            if kind is None or any(word in kind.upper() for word in NO_SENSORS):
                continue
            zones[f"thermal.{kind}-{seen[kind]}" if seen[kind] else f"thermal.{kind}"] = f"{place}/temp"
            seen[kind] += 1
        found = cls(root, zones)
        if not found.read():
            return Absent(cls.name, "no thermal zone shows a temperature (virtual machine or container)")
        return found

    def read(self) -> list[Reading]:
        """Return the temperatures in degC; a zone that is powered off gives none."""
        found: list[Reading] = []
        for name, path in self._zones.items():
            degrees = scaled(self._root, path, 1e-3)
            if degrees is not None and degrees > COLDEST:
                found += gauge(name, degrees, DEGREE)
        return found
