"""Energy of the processor package of a PC, from RAPL.

Sources: ``Documentation/power/powercap/powercap.rst`` of Linux (``energy_uj`` in uJ, starts again from zero at
``max_energy_range_uj``); readable by root alone since Linux 5.10 (CVE-2020-8694).
"""

from __future__ import annotations

import re
from pathlib import Path

from vlatool.machine.host import ROOT, read_text
from vlatool.telemetry._reading import JOULE, Absent, FileReader, NumberFile, Run, find, number

ZONE = re.compile(r"intel-rapl:\d+$")
"""A zone at the top. Its children (core, uncore, dram) are inside of it and never added."""
LABEL = "package, without the board"
UDEV_RULE = (
    'SUBSYSTEM=="powercap", KERNEL=="intel-rapl*", RUN+="/usr/bin/chgrp GROUP /sys/%p/energy_uj", '
    'RUN+="/usr/bin/chmod g+r /sys/%p/energy_uj"'
)
"""Rule that lets a group read the counters; the second part is needed because the mode is 0400."""


class RaplReader(FileReader):
    """Energy of every processor package in joules, as ``rapl.package-0``.

    The zone ``psys`` is excluded: it includes the package, and how much of the board it covers differs by vendor.
    """

    name = "rapl"

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> RaplReader | Absent:
        """Find the packages; absent where there is none, or where the counter of one cannot be read."""
        files: dict[str, NumberFile] = {}
        for folder in find(root, "sys/class/powercap", "intel-rapl:*"):
            label = read_text(root, f"{folder}/name") or ""
            if ZONE.search(folder) and label.startswith("package"):
                wraps = number(root, f"{folder}/max_energy_range_uj", 1e-6)
                files[label] = NumberFile(f"rapl.{label}", f"{folder}/energy_uj", 1e-6, JOULE, "counter", wraps, LABEL)
        if not files:
            reason = "no RAPL package is visible (virtual machine or ARM); measure at the wall"
            return Absent(cls.name, reason, other_board=True)
        reader = cls(root, files.values())
        if len(reader.read()) < len(files):
            fix = f"write into /etc/udev/rules.d/70-rapl.rules, with your group for GROUP, and reboot: {UDEV_RULE}"
            return Absent(
                cls.name, f"the energy counter is there, but cannot be read (since Linux 5.10 only root may); {fix}"
            )
        return reader
