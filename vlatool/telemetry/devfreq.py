"""Load and clock of the GPU of a Jetson.

Sources: ``Documentation/ABI/testing/sysfs-class-devfreq`` of Linux (``cur_freq`` in Hz), jetson_stats for the names of
the devices and for ``device/load`` in 0.1 %.
"""

from __future__ import annotations

import re
from pathlib import Path

from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import MEGAHERTZ, SHARE, Absent, FileReader, NumberFile, Run, find

GPU = re.compile(r"\.(gpu|ga10b|gp10b|gv11b)$|^gpu-gpc-\d+$")
"""``17000000.gpu`` and the like; ``gpu-gpc-0`` on an AGX Thor."""


class DevfreqReader(FileReader):
    """Load (share) and clock (MHz) of the GPU, as ``devfreq.gpu.load`` and ``devfreq.gpu.clock``.

    A GPU that is powered off has none.
    """

    name = "devfreq"

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> DevfreqReader | Absent:
        """Find the GPUs; absent where no device of that name can be read."""
        folders = [folder for folder in find(root, "sys/class/devfreq", "*") if GPU.search(folder.rpartition("/")[2])]
        files = []
        for index, folder in enumerate(folders):
            files.append(NumberFile(f"devfreq.gpu{index or ''}.load", f"{folder}/device/load", 1e-3, SHARE))
            files.append(NumberFile(f"devfreq.gpu{index or ''}.clock", f"{folder}/cur_freq", 1e-6, MEGAHERTZ))
        return cls(root, files).or_absent(
            "no GPU has a frequency policy in /sys/class/devfreq: this is not a Jetson", other_board=True
        )
