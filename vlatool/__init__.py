"""vlatool: robot policies that run, fast and safely, on the board that the robot carries.

``vlatool.load("bundle/")`` is all that a controller needs; nothing heavy is imported before it is called.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vlatool.machine.version import VERSION as __version__

if TYPE_CHECKING:
    from vlatool.runtime import load as load

__all__ = ["__version__", "load"]


def __getattr__(name: str) -> Any:
    if name == "load":
        from vlatool.runtime import load

        return load
    raise AttributeError(f"module 'vlatool' has no attribute {name!r}")
