"""Lines of NVIDIA's ``tegrastats``: load, clocks, temperatures and power of a Jetson.

Sources: the tegrastats page of the Jetson Linux developer guide, and recorded lines of JetPack 4 to 6. The line differs
from release to release: a date in front or not, power with ``mW`` or without, cores that are ``off``, several clocks.
"""

from __future__ import annotations

import re
from pathlib import Path

from vlatool.machine.host import ROOT
from vlatool.telemetry import _reading
from vlatool.telemetry._reading import MIN_TEMPERATURE, Absent, CommandReader, Reading, Run, gauge, runner

COMMAND = ("sh", "-c", "timeout 1 tegrastats --interval 100 | head -n 1")
"""One line: tegrastats runs until it is stopped."""
MEGABYTES = {"k": 1024 / 1e6, "M": 1024**2 / 1e6, "G": 1024**3 / 1e6}
"""tegrastats divides by 1024: one of its MB is 1.048576 MB."""
MEMORY = re.compile(r"\bRAM (\d+)/\d+([kMG])B")
CPU = re.compile(r"\bCPU \[([^\]]*)\](?:@(\d+))?")
CORE = re.compile(r"\s*(\d+)%(?:@(\d+))?\s*")
ENGINE = re.compile(r"\b([A-Z][A-Z0-9]*?)(_MAX)?(?:_FREQ)? (\d+)%(?:@\[?([\d,]+)\]?)?")
ENGINE_CLOCK = re.compile(r"\b([A-Z][A-Z0-9]*?)(_MAX)?_FREQ @?(\d+)(?= |$)")
TEMPERATURE = re.compile(r"(?<![\w-])([A-Za-z][\w-]*)@(-?\d+(?:\.\d+)?)C\b")
POWER = re.compile(r"\b([A-Z]\w*) (-?\d+)(?:mW)?/-?\d+(?:mW)?(?=\s|$)")


class TegrastatsReader(CommandReader):
    """One line of tegrastats, at most once a second; it stands in where the INA monitors cannot be read."""

    name = "tegrastats"
    period_s = 1.0
    fallback_for = "ina"

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> TegrastatsReader | Absent:
        """Ask for one line; absent without tegrastats, or when the line has no known value."""
        return cls(runner(root, run)).or_absent(
            "tegrastats prints nothing: this is not a Jetson, or the L4T tools are not installed", other_board=True
        )

    def read(self) -> list[Reading]:
        """Return the readings of one line."""
        return parse(self._run(COMMAND) or "")


def parse(line: str) -> list[Reading]:
    """Return the readings of one line: W, degC, MHz, MB and share; of ``now/average`` the first.

    Example:
        >>> [(reading.name, reading.value) for reading in parse("GR3D_FREQ 14%@[407] VDD_IN 5251mW/8535mW")]
        [('tegrastats.GR3D.load', 0.14), ('tegrastats.GR3D.clock', 407.0), ('tegrastats.VDD_IN', 5.251)]
    """
    return [*_memory(line), *_cores(line), *_engines(line), *_temperatures(line), *_power(line)]


def _memory(line: str) -> list[Reading]:
    memory = MEMORY.search(line)
    return gauge("tegrastats.RAM", float(memory[1]) * MEGABYTES[memory[2]], _reading.MEGABYTE) if memory else []


def _cores(line: str) -> list[Reading]:
    """Return load and clock of each core that is on; before JetPack 3 one clock follows the list."""
    cores = CPU.search(line)
    readings: list[Reading] = []
    for index, text in enumerate(cores[1].split(",") if cores else []):
        core = CORE.fullmatch(text)
        if core:
            clock = core[2] or (cores and cores[2])
            readings += gauge(f"tegrastats.cpu{index}.load", float(core[1]) / 100, _reading.SHARE)
            readings += gauge(f"tegrastats.cpu{index}.clock", float(clock) if clock else None, _reading.MEGAHERTZ)
    return readings


def _engines(line: str) -> list[Reading]:
    """Return load and clocks of the GPU (GR3D), the memory controller (EMC) and the engines that are on."""
    readings: list[Reading] = []
    for name, limit, load, clocks in ENGINE.findall(line):
        readings += gauge(f"tegrastats.{name}.load", float(load) / 100, _reading.SHARE)
        values = [float(clock) for clock in clocks.split(",") if clock]
        for index, value in enumerate(values):
            suffix = index if len(values) > 1 else ""
            readings += gauge(f"tegrastats.{name}.{_clock(limit)}{suffix}", value, _reading.MEGAHERTZ)
    for name, limit, clock in ENGINE_CLOCK.findall(line):
        readings += gauge(f"tegrastats.{name}.{_clock(limit)}", float(clock), _reading.MEGAHERTZ)
    return readings


def _clock(limit: str) -> str:
    return "max_clock" if limit else "clock"


def _temperatures(line: str) -> list[Reading]:
    readings: list[Reading] = []
    for name, text in TEMPERATURE.findall(line):
        if float(text) > MIN_TEMPERATURE and "PMIC" not in name.upper():
            readings += gauge(f"tegrastats.{name}.temperature", float(text), _reading.DEGREE)
    return readings


def _power(line: str) -> list[Reading]:
    readings: list[Reading] = []
    for name, milliwatts in POWER.findall(line):
        if name not in ("NC", "RAM", "SWAP", "IRAM"):
            readings += gauge(f"tegrastats.{name}", float(milliwatts) / 1e3, _reading.WATT)
    return readings
