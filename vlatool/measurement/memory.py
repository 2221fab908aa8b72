"""What this process holds in memory, as the kernel counts it."""

from __future__ import annotations

import resource
from pathlib import Path


def resident_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the resident set of this process in MB (10^6 bytes)."""
    for line in status.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024 / 1e6
    return peak_rss_mb(status)


def peak_rss_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the largest resident set of this process so far in MB (10^6 bytes).

    ``ru_maxrss`` would do, but Linux lets a child inherit its parent's value; ``VmHWM`` belongs to the process alone.
    """
    for line in status.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
