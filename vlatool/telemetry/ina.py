"""Power of the rails of a Jetson from its INA3221 and INA238 monitors.

Sources: ``Documentation/hwmon/ina3221.rst`` and ``ina238.rst`` of Linux (volts in mV, current in mA, ``power1_input``
in uW; inputs 4 to 7 of an INA3221 are shunt voltages), jetson_stats for the paths of JetPack 4 and for the rails.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from vlatool.machine.host import ROOT, read_text
from vlatool.telemetry._reading import WATT, Absent, Reader, Reading, Run, find, gauge, number

HWMON = (
    ("sys/class/hwmon", "hwmon*"),
    ("sys/bus/i2c/drivers", "ina3221*/*/hwmon/hwmon*"),
    ("sys/bus/i2c/drivers", "ina238*/*/hwmon/hwmon*"),
)
"""Folders of monitors; the first one with monitors is read, since the others show the same chips again."""
IIO = ("sys/bus/i2c/drivers", "ina3221*/*/iio:device*")
"""JetPack 4: ``rail_name_N`` and ``in_powerN_input`` in mW."""
CHANNELS = (1, 2, 3)
NO_RAIL = "NC"
"""The label of a channel that is not connected."""
REASON = (
    "no INA3221 or INA238 power monitor is visible: this is not a Jetson, or a container hides it "
    "(mount /sys read-only); otherwise measure at the supply"
)


@dataclass(frozen=True)
class _Rail:
    """Files of one rail: volts and current (mV, mA), or power with its scale to watts."""

    label: str
    power: str
    scale: float = 1e-6
    current: str = ""

    def watts(self, root: Path) -> float | None:
        power = number(root, self.power, self.scale)
        if not self.current or power is None:
            return power
        amperes = number(root, self.current, 1e-3)
        return None if amperes is None else power * amperes


class InaReader(Reader):
    """Power of every labelled rail in watts, as ``ina.LABEL``; a rail of one label on two chips gets an index.

    ``hwmonN`` changes from boot to boot, so chips are found by their name. A current may be below zero: the chips are
    signed and not calibrated at zero.
    """

    name = "ina"

    def __init__(self, root: Path, rails: list[_Rail]) -> None:
        self._root = root
        self._rails = rails

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> InaReader | Absent:
        """Find the rails; absent where there is no monitor or none of its rails can be read."""
        rails = _with_indexes(_hwmon(root) or list(_iio(root)))
        if not rails:
            return Absent(cls.name, REASON, other_board=True)
        return cls(root, rails).or_absent("there are power monitors, but none of their rails can be read; check dmesg")

    def read(self) -> list[Reading]:
        """Return the power of the rails in watts."""
        return [reading for rail in self._rails for reading in gauge(f"ina.{rail.label}", rail.watts(self._root), WATT)]


def _with_indexes(rails: list[_Rail]) -> list[_Rail]:
    """Give the second rail of the same label the index 1, and so on."""
    counts: Counter[str] = Counter()
    numbered = []
    for rail in rails:
        index = counts[rail.label]
        counts[rail.label] += 1
        numbered.append(replace(rail, label=f"{rail.label}-{index}") if index else rail)
    return numbered


def _hwmon(root: Path) -> list[_Rail]:
    for folder, pattern in HWMON:
        rails = [rail for folder in find(root, folder, pattern) for rail in _chip(root, folder)]
        if rails:
            return rails
    return []


def _chip(root: Path, folder: str) -> Iterator[_Rail]:
    chip = read_text(root, f"{folder}/name")
    if chip == "ina3221":
        for channel in CHANNELS:
            label = read_text(root, f"{folder}/in{channel}_label")
            if label and label != NO_RAIL:
                yield _Rail(label, f"{folder}/in{channel}_input", 1e-3, f"{folder}/curr{channel}_input")
    elif chip == "ina238" and (root / folder / "power1_input").exists():
        yield _Rail(_label_of_ina238(root, folder), f"{folder}/power1_input", 1e-6)


def _label_of_ina238(root: Path, folder: str) -> str:
    """Return the label of the chip; one without a label on an AGX Thor is the input rail (jetson_stats #900)."""
    for name in ("in1_label", "power1_label", "label"):
        if label := read_text(root, f"{folder}/{name}"):
            return label
    return "VIN" if "thor" in (read_text(root, "proc/device-tree/model") or "").lower() else "INA238"


def _iio(root: Path) -> Iterator[_Rail]:
    for folder in find(root, *IIO):
        for path in find(root, folder, "rail_name_*"):
            label = read_text(root, path)
            channel = re.search(r"rail_name_(\d+)$", path)
            if channel and label and label != NO_RAIL:
                yield _Rail(label, f"{folder}/in_power{channel[1]}_input", 1e-3)
