"""Ask an engine in a child process how it computes int8 products: one that aborts must not end the command."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping
from typing import Any

from vlatool.machine.engine_calls import engine_call
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class
from vlatool.user_code import children


def int8_arithmetic(engine: str = "") -> str:
    """Return what ``Engine.arithmetic`` of an engine gives, asked once in a process.

    Args:
        engine: its name; the default engine when empty.

    Raises:
        VlatoolError: what it raises; GraphError when the engine ends the child, or hangs.
    """
    return _ask_engine(engine or DEFAULT_ENGINE, os.environ.get(MAX_CPU_ISA, ""))


@functools.cache
def _ask_engine(engine: str, _confined_to: str) -> str:
    library, job = engine_class(engine), {"engine": engine}
    preload = ("numpy", library.package, __name__)
    about = f"the int8 products of {library.title or engine}"
    return str(children.call(f"{__name__}:run", job, lambda _what, _share: None, about, preload, own=True))


def run(job: Mapping[str, Any], _tell: Callable[[str, float | None], None]) -> str:
    """Ask the engine of a job in this process."""
    library = engine_class(job["engine"])
    with engine_call(library, "computed small int8 products"):
        return str(library.arithmetic())
