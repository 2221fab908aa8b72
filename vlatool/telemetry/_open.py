"""Open every reader that there is; a new file in this folder is found by its name."""

from __future__ import annotations

from pathlib import Path

from vlatool import registry
from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import Absent, Reader, Run


def open_all(root: Path = ROOT, run: Run | None = None) -> list[Reader | Absent]:
    """Open all readers of the machine whose file system is below ``root``.

    A reader that only stands in for another one is opened when that one is absent; otherwise it is not mentioned.

    Args:
        root: The root of the file system, or of a copied tree.
        run: What runs commands; without it they run on this machine, and not at all for a copied tree.

    Returns:
        For every source its reader, or why it is unmeasured.
    """
    files = [registry.load("telemetry", name) for name in registry.names("telemetry")]
    classes: list[type[Reader]] = [kind for kind in files if issubclass(kind, Reader)]
    opened = {kind.name: kind.open(root, run) for kind in classes if not kind.fallback_for}
    for kind in classes:
        if kind.fallback_for and not isinstance(opened.get(kind.fallback_for), Reader):
            opened[kind.name] = kind.open(root, run)
    return list(opened.values())
