"""Telemetry of a board during a run: power, energy, temperatures, clocks and throttling.

One file for each source. ``open_all`` gives the readers of this machine and what it lacks; ``Recorder`` samples them.
"""

from pathlib import Path

from vlatool import registry
from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import DEGREE, THROTTLE, Absent, Reader, Reading, Run
from vlatool.telemetry._summary import Change, Energy, Gauge, Series, Summary, collect, summarise
from vlatool.telemetry._total import Total, totals
from vlatool.telemetry.recorder import Recorder

__all__ = [
    "DEGREE",
    "THROTTLE",
    "Absent",
    "Change",
    "Energy",
    "Gauge",
    "Reader",
    "Reading",
    "Recorder",
    "Run",
    "Series",
    "Summary",
    "Total",
    "collect",
    "open_all",
    "summarise",
    "totals",
]


def open_all(root: Path = ROOT, run: Run | None = None) -> list[Reader | Absent]:
    """Open all readers of the machine whose file system is below ``root``.

    A fallback reader is opened only when the reader that it replaces is absent, and otherwise not mentioned.

    Args:
        root: Root of the file system, or of a copied tree.
        run: Function that runs commands; by default on this machine, and not at all for a copied tree.

    Returns:
        The reader of each source, or why it is unmeasured.
    """
    files = [registry.load("telemetry", name) for name in registry.names("telemetry")]
    classes: list[type[Reader]] = [kind for kind in files if issubclass(kind, Reader)]
    opened = {kind.name: kind.open(root, run) for kind in classes if not kind.fallback_for}
    for kind in classes:
        if kind.fallback_for and not isinstance(opened.get(kind.fallback_for), Reader):
            opened[kind.name] = kind.open(root, run)
    return list(opened.values())
