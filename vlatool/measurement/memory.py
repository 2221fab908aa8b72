"""What this process holds in memory, as the kernel counts it."""

from __future__ import annotations

import resource
from pathlib import Path


def resident_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the resident set of this process in MB (10^6 bytes)."""
    resident = _line_mb(status, "VmRSS:")
    return peak_rss_mb(status) if resident is None else resident


def peak_rss_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the largest resident set of this process so far in MB (10^6 bytes).

    ``ru_maxrss`` would do, but Linux lets a child inherit its parent's value; ``VmHWM`` belongs to the process alone.
    """
    peak = _line_mb(status, "VmHWM:")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6 if peak is None else peak


def _line_mb(status: Path, name: str) -> float | None:
    lines = status.read_text(encoding="utf-8").splitlines()
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(name)), None)
