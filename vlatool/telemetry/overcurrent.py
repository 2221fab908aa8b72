"""How often a Jetson throttled because a rail took too much current or the supply sagged.

Source: the electrical management page of the Jetson Linux developer guide (``oc1_event_cnt`` to ``oc3_event_cnt`` of
a hardware monitor; which limit each one guards differs by module).
"""

from __future__ import annotations

import re
from pathlib import Path

from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import THROTTLE, Absent, Reader, Reading, Run, counter, listed, scaled

COUNT = re.compile(r"/(oc\d+)_event_cnt$")


class OvercurrentReader(Reader):
    """Events of every over-current alarm, as ``overcurrent.oc1``."""

    name = "overcurrent"

    def __init__(self, root: Path, paths: list[str]) -> None:
        self._root = root
        self._counts = {f"overcurrent.{found[1]}": path for path in paths if (found := COUNT.search(path))}

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> OvercurrentReader | Absent:
        """Find the counters; absent where there are none, which is everywhere but on a Jetson."""
        found = cls(root, listed(root, "sys/class/hwmon", "hwmon*/oc*_event_cnt"))
        if not found.read():
            return Absent(cls.name, "no over-current counters: this is no Jetson with JetPack 5 or later")
        return found

    def read(self) -> list[Reading]:
        """Return the event counters."""
        found: list[Reading] = []
        for name, path in self._counts.items():
            words = f"over-current alarm {name.rpartition('.')[2].upper()}"
            found += counter(name, scaled(self._root, path, 1.0), THROTTLE, note=words)
        return found
