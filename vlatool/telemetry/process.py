"""Resources of this process, and CPU time stolen by the host of a virtual machine.

Source: ``Documentation/filesystems/proc.rst`` of Linux. Where there is no ``/proc``, psutil is asked if installed.
"""

from __future__ import annotations

import contextlib
import importlib
import re
from pathlib import Path
from typing import Any

from vlatool.machine.host import ROOT, read_text
from vlatool.telemetry import _reading
from vlatool.telemetry._reading import Absent, Reader, Reading, Run, counter, find, gauge

TICKS = 100.0
"""Clock ticks in a second: USER_HZ is 100 on x86 and ARM (``include/asm-generic/param.h`` of Linux)."""
STAT = re.compile(r"^\d+ \(.*\) \S(?: -?\d+){10} (\d+) (\d+) ", re.DOTALL)
"""Fields 14 and 15, user and system time; the name in brackets may hold brackets and blanks."""
RESIDENT = re.compile(r"^VmRSS:\s+(\d+) kB$", re.MULTILINE)
SWITCHES = re.compile(r"^nonvoluntary_ctxt_switches:\s+(\d+)$", re.MULTILINE)
STEAL = re.compile(r"^cpu +(?:\d+ +){7}(\d+)\b", re.MULTILINE)


class ProcessReader(Reader):
    """CPU seconds (10 ms steps), memory (MB) and involuntary context switches of this process, and stolen seconds.

    An involuntary switch means that something else wanted the core. Switches are added up over the threads, those that
    have ended included from the moment they were seen. Steal time is that of the whole machine, over all its cores.

    Args:
        process: An object of psutil instead of ``/proc``.
        number: ID of another process to read; 0 for this one.
    """

    name = "process"

    def __init__(self, root: Path, process: Any = None, number: int = 0) -> None:
        self._root = root
        self._folder = f"proc/{number or 'self'}"
        self._process = process
        self._switches: dict[str, int] = {}

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None, number: int = 0) -> ProcessReader | Absent:
        """Read ``/proc``, or open psutil on this machine; absent where there is neither."""
        reader = cls(root, number=number)
        if not reader.read() and root == ROOT:
            with contextlib.suppress(ImportError):
                reader = cls(root, importlib.import_module("psutil").Process(number or None))
        return reader.or_absent("/proc is missing; on systems other than Linux: pip install psutil")

    def read(self) -> list[Reading]:
        """Return the counters of this process and the machine's steal time."""
        return self._psutil() if self._process is not None else [*self._proc(), *self._steal()]

    def _proc(self) -> list[Reading]:
        times = STAT.search(read_text(self._root, f"{self._folder}/stat") or "")
        readings = _times((int(times[1]) + int(times[2])) / TICKS if times else None)
        resident = RESIDENT.search(read_text(self._root, f"{self._folder}/status") or "")
        readings += gauge("process.memory", int(resident[1]) * 1024 / 1e6 if resident else None, _reading.MEGABYTE)
        for path in find(self._root, f"{self._folder}/task", "*/status"):
            if switches := SWITCHES.search(read_text(self._root, path) or ""):
                self._switches[path] = int(switches[1])
        return readings + _switches(sum(self._switches.values()) if self._switches else None)

    def _steal(self) -> list[Reading]:
        stolen = STEAL.search(read_text(self._root, "proc/stat") or "")
        seconds = int(stolen[1]) / TICKS if stolen else None
        return counter("process.machine_steal", seconds, _reading.SECOND, note="taken by the host of a virtual machine")

    def _psutil(self) -> list[Reading]:
        try:
            with self._process.oneshot():
                times = self._process.cpu_times()
                memory = self._process.memory_info().rss / 1e6
                switches = self._process.num_ctx_switches().involuntary
        except Exception:  # psutil.Error, or what one platform does not have
            return []
        readings = _times(times.user + times.system) + gauge("process.memory", memory, _reading.MEGABYTE)
        return readings + _switches(switches)


def _times(seconds: float | None) -> list[Reading]:
    return counter("process.cpu", seconds, _reading.SECOND, note="user and system time, all threads")


def _switches(count: int | None) -> list[Reading]:
    return counter("process.involuntary_switches", count, _reading.COUNT)
