"""Stages in child processes: both sides of the call.

It runs a user's code, needs an environment of its own, or lets an engine open graphs that may end the process.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.errors import PluginError, RecipeError, VlatoolError
from vlatool.files.printable import message_of
from vlatool.report import Report
from vlatool.stage.base import Context, Measure, Stage, Transform
from vlatool.stage.build import build_stage
from vlatool.user_code import children

PRELOAD = ("torch", "onnx", "onnxscript", "onnxruntime", "vlatool.export.onnx", __name__)
"""What stages with a user's code need; imported once, by the server that forks the children."""


def child_imports(stage: Stage) -> tuple[str, ...]:
    """Return the modules that a child needs for a stage of vlatool's own code; the server imports them once."""
    packages = (package.replace("-", "_") for package in stage.used_packages())
    return (*packages, *stage.imports, "numpy.random", type(stage).__module__, __name__)


def run_in_child(stage: Transform, source: Bundle | None, draft: Path, context: Context) -> Bundle:
    """Run a stage in a child process and return what it wrote to ``draft``, verified where a user's code took part.

    Raises:
        VlatoolError: what the stage raises; SourceError, or GraphError of an engine, when the child ends before it is
            done.
        BundleError: when what it wrote is not a whole bundle.
    """
    job, whose = {**_job(stage, source, context), "out": str(draft)}, stage.runs(source)
    about, preload = whose or stage.name(), (*PRELOAD, *stage.imports) if whose else child_imports(stage)
    answer = children.call("vlatool.stage._child:run", job, context.progress, about, preload, own=not whose)
    said = answer.get("said") if isinstance(answer, Mapping) else None
    context.messages.extend(map(str, said if isinstance(said, list) else ()))  # a policy may have answered
    return Bundle.open(draft, verify=bool(whose))


def _job(stage: Stage, source: Bundle | None, context: Context) -> dict[str, Any]:
    """Return what a child needs to know of a stage."""
    return {
        "stage": stage.name(), "options": stage.explicit_options(), "workers": context.workers,
        "launcher": context.launcher,
        "source": str(source.path.absolute()) if source else "", "command": context.command,
        "events": context.events, "video": context.video, "force": context.force,
    }  # fmt: skip


def run(job: Mapping[str, Any], tell: Callable[[str, float | None], None]) -> dict[str, Any]:
    """Run the stage of a job in this process; return the hash of the bundle that it made, and what is said of it."""
    stage = build_stage(job["stage"], job["options"])
    if not isinstance(stage, Transform):
        raise RecipeError(f"The stage {job['stage']} measures; it makes no bundle.", "name a stage that makes a bundle")
    source = Bundle.open(Path(job["source"]), verify=False) if job["source"] else None
    context = _context(job, tell)
    with _name_plugin():
        bundle = stage.run(source, Path(job["out"]), context)
    return {"hash": bundle.hash, "said": context.messages}


def measure_in_child(environment: Mapping[str, str], stage: Measure, source: Bundle, context: Context) -> Report:
    """Run a measuring stage in a child process that has further variables from its start."""
    job, settings = _job(stage, source, context), " ".join(f"{name}={value}" for name, value in environment.items())
    about = f"{stage.name()} with {settings}" if settings else stage.name()
    job["keeps"] = context.unfinished is not None
    here, preload = "vlatool.stage._child:measure", child_imports(stage)
    answer = children.call(here, job, context.progress, about, preload, environment, own=True)
    if context.unfinished is not None:
        context.unfinished.extend(map(Path, answer["unfinished"]))
    context.notes.extend(map(str, answer["notes"]))
    return Report.from_json(str(answer["report"]))


def measure(job: Mapping[str, Any], tell: Callable[[str, float | None], None]) -> dict[str, Any]:
    """Run the measuring stage of a job in this process; return its report as JSON, and what it kept and noted."""
    stage = build_stage(job["stage"], job["options"])
    if not isinstance(stage, Measure):
        raise RecipeError(
            f"The stage {job['stage']} makes a bundle; it measures nothing.", "name a stage that measures"
        )
    source = Bundle.open(Path(job["source"]), verify=False)
    unfinished: list[Path] = []
    context = replace(_context(job, tell), unfinished=unfinished if job["keeps"] else None)
    with _name_plugin():
        report = stage.run(source, context).to_json()
    return {"report": report, "unfinished": list(map(str, unfinished)), "notes": context.notes}


@contextlib.contextmanager
def _name_plugin() -> Iterator[None]:
    """Name the package that adds a stage when that fails: the parent does not see where an exception came from."""
    try:
        yield
    except (VlatoolError, OSError, MemoryError):
        raise
    except Exception as error:
        if owner := registry.package_at_fault(error):
            raise PluginError(*registry.plugin_failure(owner, type(error).__name__, message_of(error))) from error
        raise


def _context(job: Mapping[str, Any], tell: Callable[[str, float | None], None]) -> Context:
    return Context(tell, job["workers"], job["command"], events=job["events"], launcher=job["launcher"],
                   video=job["video"], force=job["force"])  # fmt: skip
