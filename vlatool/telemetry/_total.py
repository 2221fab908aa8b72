"""Readings that add up to the power of the board, and what the sum excludes.

Rails overlap: the input rail of a Jetson holds all others, so they are never added to it (jetson_stats #51).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from vlatool.telemetry._reading import JOULE, WATT, Reading

INPUT_RAILS = {
    "VDD_IN": "module input VDD_IN, without the carrier board",
    "VIN": "board input VIN",
    "POM_5V_IN": "board input POM_5V_IN",
}
"""Rail -> what it holds: Orin Nano, Orin NX, Xavier NX and TX2; AGX Thor (jetson_stats #900); Nano."""
MODULE_RAILS = (
    ("VDD_GPU_SOC", "VDD_CPU_CV", "VIN_SYS_5V0", "VDDQ_VDD2_1V8AO"),
    ("GPU", "CPU", "SOC", "CV", "VDDRQ", "SYS5V"),
)
"""All rails of the modules without an input rail: AGX Orin (monitors 0x40 and 0x41), AGX Xavier."""
JETSON_READERS = ("ina", "tegrastats")
PMIC_LABEL = "PMIC rails, without USB"


@dataclass(frozen=True)
class Total:
    """Readings that add up to the power of something.

    Args:
        unit: ``J`` for energy counters, ``W`` for power.
        label: Description of the sum, with exclusions.
    """

    names: tuple[str, ...]
    unit: str
    label: str


def totals(readings: Iterable[Reading]) -> list[Total]:
    """Return the totals: the board or its processor first, then the graphics cards, which are never added to it.

    ``readings`` are all readings, one for each name. Empty when no reading is known to be a total.
    """
    units = {reading.name: reading.unit for reading in readings if reading.unit in (WATT, JOULE)}
    board = [total for total in (_jetson(units), _pmic(units), _package(units)) if total is not None]
    cards = _cards(units)
    return board[:1] + ([cards] if cards else [])


def _jetson(units: dict[str, str]) -> Total | None:
    for reader in JETSON_READERS:
        rails = {name.removeprefix(f"{reader}.") for name in units if name.startswith(f"{reader}.")}
        for rail, label in INPUT_RAILS.items():
            if rail in rails:
                return Total((f"{reader}.{rail}",), WATT, label)
        for module in MODULE_RAILS:
            if rails >= {*module[:2]}:
                names = tuple(f"{reader}.{rail}" for rail in module if rail in rails)
                missing = [rail for rail in module if rail not in rails]
                return Total(names, WATT, ", without ".join(["module sum", *missing]))
    return None


def _pmic(units: dict[str, str]) -> Total | None:
    names = tuple(name for name, unit in units.items() if name.startswith("vcgencmd.") and unit == WATT)
    return Total(names, WATT, PMIC_LABEL) if names else None


def _package(units: dict[str, str]) -> Total | None:
    names = tuple(name for name, unit in units.items() if name.startswith("rapl.") and unit == JOULE)
    count = f"{len(names)} packages" if len(names) > 1 else "package"
    return Total(names, JOULE, f"{count}, without the board") if names else None


def _cards(units: dict[str, str]) -> Total | None:
    """Take the energy counters when every card has one, else the power of every card."""
    names = [name for name in units if name.startswith("nvml.")]
    cards = {name.rpartition(".")[0] for name in names}
    label = f"{len(cards)} graphics cards" if len(cards) > 1 else "graphics card"
    for unit in (JOULE, WATT):
        chosen = tuple(name for name in names if units[name] == unit)
        if chosen and len(chosen) == len(cards):
            return Total(chosen, unit, label)
    return None
