"""What goes wrong on a bus, for the person who started a node on it.

Messages that do not decode, types and qualities of service that do not fit, handlers that raise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from vlatool.buses import Bus, Fault
from vlatool.nodes.stepper import StepReport

LOOK_S = 0.5
"""Time between two looks at the faults of a bus, in seconds."""


class FaultWatch:
    """Passes on the first fault of each topic, soon after it happened; an observer of a run.

    Args:
        bus: The bus.
        on_fault: Called with the fault.
    """

    def __init__(self, bus: Bus, on_fault: Callable[[Fault], None]) -> None:
        self._bus, self._on_fault = bus, on_fault
        self._topics: set[str] = set()
        self._next_s = 0.0

    def __call__(self, report: StepReport) -> None:
        """Look at the faults, if it is time to."""
        if report.snapshot.time_s < self._next_s:
            return
        self._next_s = report.snapshot.time_s + LOOK_S
        for fault in self._bus.faults():
            if fault.topic not in self._topics:
                self._topics.add(fault.topic)
                self._on_fault(fault)


def fault_text(fault: Fault) -> str:
    """Return a line on a fault."""
    often = f" ({fault.count} times)" if fault.count > 1 else ""
    return f"{fault.error.message}{often}; {fault.error.fix}" if fault.error.fix else f"{fault.error.message}{often}"


def to_plain_faults(faults: Iterable[Fault]) -> list[dict[str, Any]]:
    """Return faults as plain values for JSON."""
    return [{"topic": each.topic, "count": each.count, "error": each.error.message, "fix": each.error.fix}
            for each in faults]  # fmt: skip
