"""What Linux says about the processor: the flags of ``/proc/cpuinfo``. Standard library alone."""

from __future__ import annotations

import re
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
HOST = Path("/proc/self/root/proc/cpuinfo")
"""The same file by a path that a confined environment does not mask."""


def flags(text: str) -> frozenset[str]:
    """Return the flags that every core in a ``/proc/cpuinfo`` has; none where there is no such line."""
    lines = re.findall(r"^flags\s*:\s*(.*)$", text, re.MULTILINE)
    return frozenset.intersection(*(frozenset(line.split()) for line in lines)) if lines else frozenset()
