"""Run a bundle once in a child process before this one opens it: an engine may crash on a graph from elsewhere.

What this process makes ran in the child that made it. Any other bundle may hold a graph on which the engine of this
machine has never run.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class
from vlatool.runtime.policy import Policy
from vlatool.stage.finish import graph_names
from vlatool.user_code import children

_runs: set[tuple[str, str]] = set()


def remember_run(bundle: Bundle) -> None:
    """Remember that the engine of a bundle ran it on this machine."""
    _runs.add((bundle.hash, bundle.manifest.engine or DEFAULT_ENGINE))


def run_once_in_child(bundle: Bundle, engine: str = "") -> None:
    """Open and run a bundle once in a child process, unless its engine ran it before.

    Raises:
        GraphError: when the engine crashes or hangs; what it refuses is left to whoever opens the bundle next.
    """
    engine = engine or bundle.manifest.engine or DEFAULT_ENGINE
    if (bundle.hash, engine) in _runs or not bundle.manifest.graphs:
        return
    job = {"bundle": str(bundle.path.absolute()), "engine": engine}
    preload = ("numpy", engine_class(engine).package, __name__)
    about = f"the first run of {bundle.path}"
    children.call("vlatool.stage.first_run:run", job, lambda _what, _share: None, about, preload, own=True)
    _runs.add((bundle.hash, engine))


def run(job: Mapping[str, Any], _tell: Callable[[str, float | None], None]) -> None:
    """Open and run the bundle of a job in this process."""
    bundle, engine = Bundle.open(Path(job["bundle"]), verify=False), str(job["engine"])
    with contextlib.suppress(VlatoolError):
        policy = Policy.open(bundle, engine=engine, threads=1, seed=0)
        with engine_call(engine_class(engine), f"ran {graph_names(bundle.manifest)}"):
            policy.warm_up(1)
