"""Clocks of the processor, and thermal throttle events of x86 processors.

Sources: ``Documentation/admin-guide/pm/cpufreq.rst`` (``scaling_cur_freq`` in kHz) and
``Documentation/admin-guide/thermal/intel_thermal_throttle.rst`` of Linux (``thermal_throttle/*_throttle_count``).
"""

from __future__ import annotations

import re
from pathlib import Path

from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import MEGAHERTZ, THROTTLE, Absent, Reader, Reading, Run, counter, find, gauge, number

CPUS = "sys/devices/system/cpu"
COUNT = re.compile(r"/(core|package)_throttle_count$")
NO_COUNTS = (
    "this processor has no thermal_throttle counters (they are Intel's, and hidden in virtual machines): "
    "throttling shows only in clocks and temperatures"
)


class CpufreqReader(Reader):
    """Clock of every policy in MHz, as ``cpufreq.policyN``, and throttle events of the cores and of the package.

    On a Jetson ``scaling_cur_freq`` may show the requested clock while the firmware enforces a lower one. The events
    are added up over the logical processors; siblings count the same event, so only whether the sum moved is exact.
    """

    name = "cpufreq"

    def __init__(self, root: Path, policies: list[str], counts: list[str]) -> None:
        self._root = root
        self._policies = {f"cpufreq.{folder.rpartition('/')[2]}": f"{folder}/scaling_cur_freq" for folder in policies}
        self._counts = {path: part[1] for path in counts if (part := COUNT.search(path))}
        self._last: dict[str, float] = {}

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> CpufreqReader | Absent:
        """Find policies and counters; absent where there are neither."""
        policies = find(root, f"{CPUS}/cpufreq", "policy*")
        counts = find(root, CPUS, "cpu[0-9]*/thermal_throttle/*_throttle_count")
        return cls(root, policies, counts).or_absent(
            "neither clocks nor throttle counters are visible (virtual machine or container)", other_board=True
        )

    def read(self) -> list[Reading]:
        """Return clocks in MHz and the sums of the throttle counters."""
        readings: list[Reading] = []
        for name, path in self._policies.items():
            readings += gauge(name, number(self._root, path, 1e-3), MEGAHERTZ)
        for path in self._counts:
            if (value := number(self._root, path, 1.0)) is not None:
                self._last[path] = value
        for part in ("core", "package"):
            known = [value for path, value in self._last.items() if self._counts[path] == part]
            words = f"{part} thermal throttling"
            readings += counter(f"cpufreq.{part}_throttle_count", sum(known) if known else None, THROTTLE, note=words)
        return readings

    def absent(self) -> list[Absent]:
        """Return the throttle counters when this processor has none."""
        return [] if self._last else [Absent("cpufreq throttle counters", NO_COUNTS)]
