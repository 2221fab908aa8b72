"""What processes that vlatool starts have in common: they find this vlatool, in as many threads as are meant."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

SINGLE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Variables that make numpy's libraries compute in one thread; read when they are loaded."""


def environment() -> dict[str, str]:
    """Return the variables of a process that imports this vlatool, installed or not."""
    package = str(Path(__file__).parents[1])
    path = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path}


@contextlib.contextmanager
def single_threads() -> Iterator[None]:
    """Let processes that are started meanwhile compute in one thread: they are as many as there are processors."""
    before = {name: os.environ.get(name) for name in SINGLE}
    os.environ.update(SINGLE)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
