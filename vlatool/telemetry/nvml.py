"""Power, energy, temperature, clocks and throttle reasons of NVIDIA graphics cards, from NVML.

Source: the NVML API reference (power in mW, energy in mJ since the driver was loaded). Needs ``nvidia-ml-py``; it is
imported only here. On most Jetsons NVML is there, but answers "not supported" to all of it.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from vlatool.machine.host import ROOT
from vlatool.telemetry import _reading
from vlatool.telemetry._reading import Absent, Reader, Reading, Run, counter, gauge

LABEL = "graphics card"
REASONS = {
    0x04: "software power cap",
    0x08: "hardware slowdown",
    0x20: "software thermal slowdown",
    0x40: "hardware thermal slowdown",
    0x80: "hardware power brake",
}
"""Bits of the clock event reasons that mean throttling; an idle card (0x01) or clocks set by a user (0x02) do not."""
REASON_CALLS = ("nvmlDeviceGetCurrentClocksEventReasons", "nvmlDeviceGetCurrentClocksThrottleReasons")
"""The new name and the one before driver 535."""


class NvmlReader(Reader):
    """Every card as ``nvml.gpuN``: power (W), energy (J), temperature (degC), clocks (MHz), load and throttling.

    The power is an average over up to a second on some cards, so energy is better taken from the counter.
    """

    name = "nvml"

    def __init__(self, library: Any, cards: list[Any]) -> None:
        self._library = library
        self._cards = cards

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> NvmlReader | Absent:
        """Open the library; absent without it, without a card, or where the cards support nothing."""
        if root != ROOT:
            return Absent(cls.name, "NVML reads this machine, not a copied tree")
        try:
            library = importlib.import_module("pynvml")
        except ImportError:
            reason = "nvidia-ml-py is not installed; with an NVIDIA card: pip install nvidia-ml-py"
            return Absent(cls.name, reason, other_board=True)
        try:
            library.nvmlInit()
            cards = [library.nvmlDeviceGetHandleByIndex(index) for index in range(library.nvmlDeviceGetCount())]
        except library.NVMLError as error:
            reason = f"NVML cannot be opened ({error}): there is no NVIDIA card or driver"
            return Absent(cls.name, reason, other_board=True)
        return cls(library, cards).or_absent(
            "NVML supports nothing here, as on most Jetsons; their INA monitors are read instead", other_board=True
        )

    def read(self) -> list[Reading]:
        """Return the readings of the cards, without unsupported ones."""
        return [reading for index, card in enumerate(self._cards) for reading in self._card(f"nvml.gpu{index}", card)]

    def _card(self, name: str, card: Any) -> list[Reading]:
        readings = gauge(f"{name}.power", self._ask(1e-3, "nvmlDeviceGetPowerUsage", card), _reading.WATT, LABEL)
        energy = self._ask(1e-3, "nvmlDeviceGetTotalEnergyConsumption", card)
        readings += counter(f"{name}.energy", energy, _reading.JOULE, note=LABEL)
        degrees = self._ask(1.0, "nvmlDeviceGetTemperature", card, "NVML_TEMPERATURE_GPU")
        readings += gauge(f"{name}.temperature", degrees, _reading.DEGREE)
        for part, kind in (("sm", "NVML_CLOCK_SM"), ("memory", "NVML_CLOCK_MEM")):
            clock = self._ask(1.0, "nvmlDeviceGetClockInfo", card, kind)
            readings += gauge(f"{name}.{part}_clock", clock, _reading.MEGAHERTZ)
        for call in REASON_CALLS:
            bits = self._ask(1.0, call, card)
            if bits is not None:
                return readings + _reasons(name, int(bits))
        return readings

    def _ask(self, factor: float, call: str, card: Any, constant: str = "") -> float | None:
        """Call NVML and scale the answer; None when the library, the driver or the card does not have it."""
        try:
            arguments = [getattr(self._library, constant)] if constant else []
            return float(getattr(self._library, call)(card, *arguments)) * factor
        except (self._library.NVMLError, AttributeError, TypeError, ValueError):
            return None


def _reasons(name: str, bits: int) -> list[Reading]:
    return [
        reading
        for bit, words in REASONS.items()
        for reading in gauge(f"{name}.{words.replace(' ', '_')}", float(bool(bits & bit)), _reading.THROTTLE, words)
    ]
