"""Throttle events of a Jetson because a rail drew too much current or the supply sagged.

Source: the electrical management page of the Jetson Linux developer guide (``oc1_event_cnt`` to ``oc3_event_cnt`` of
a hardware monitor; which limit each one guards differs by module).
"""

from __future__ import annotations

import re
from pathlib import Path

from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import THROTTLE, Absent, FileReader, NumberFile, Run, find

COUNT = re.compile(r"/(oc\d+)_event_cnt$")


class OvercurrentReader(FileReader):
    """Events of every over-current alarm, as ``overcurrent.oc1``."""

    name = "overcurrent"

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> OvercurrentReader | Absent:
        """Find the counters; absent where there are none, which is everywhere but on a Jetson."""
        paths = {
            match[1]: path
            for path in find(root, "sys/class/hwmon", "hwmon*/oc*_event_cnt")
            if (match := COUNT.search(path))
        }
        files = [
            NumberFile(
                f"overcurrent.{alarm}", path, 1.0, THROTTLE, "counter", note=f"over-current alarm {alarm.upper()}"
            )
            for alarm, path in paths.items()
        ]
        return cls(root, files).or_absent(
            "no over-current counters: this is not a Jetson with JetPack 5 or later", other_board=True
        )
