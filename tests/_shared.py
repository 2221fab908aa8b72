"""What is made once in a run of the tests, however many processes run them: exports, and what is quantized of them.

Nobody may change it; copy it to damage it.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest

VARIABLE = "VLATOOL_TESTS_SHARED"
"""Names the folder, in the processes of the tests."""


def found(factory: pytest.TempPathFactory) -> Path:
    """Return the folder that all processes of this run share, new if need be."""
    own = factory.getbasetemp()
    place = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    place.mkdir(exist_ok=True)
    return place


def once(name: str, make: Callable[[Path], object]) -> Path:
    """Return the folder of that name, which the first who asks makes; the others wait for it.

    Args:
        name: One for each content.
        make: Gets the path of the folder, which does not exist yet.
    """
    place = Path(os.environ[VARIABLE])
    with (place / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / f"{name}.made").exists():
            make(place / name)
            (place / f"{name}.made").touch()
    return place / name
