"""Stages in child processes: both sides of the call.

It runs a user's code, needs an environment of its own, or lets an engine open graphs that may end the process.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.module_bundle import factory_of
from vlatool.errors import PluginError, RecipeError, VlatoolError
from vlatool.files.printable import message_of
from vlatool.report import Report
from vlatool.stage.base import Context, Measure, OnProgress, Result, Stage, Transform
from vlatool.stage.build import AnyStage, build_stage
from vlatool.user_code import children

PRELOAD = ("torch", "onnx", "onnxscript", "onnxruntime", "vlatool.export.onnx", __name__)
"""What stages with a user's code need; imported once, by the server that forks the children."""

CHILD_FIELDS = ("workers", "command", "events", "video", "force", "launcher", "work")
"""Fields of the context that a child gets; the others are functions of its parent."""


def child_imports(stage: Stage) -> tuple[str, ...]:
    """Return the modules that a child needs for a stage of vlatool's own code; the server imports them once."""
    packages = (package.replace("-", "_") for package in stage.used_packages())
    return (*packages, *stage.imports, "numpy.random", type(stage).__module__, __name__)


def run_in_child(stage: Transform, source: Bundle | None, draft: Path, context: Context) -> Result:
    """Run a stage in a child process; what it wrote to ``draft`` is verified where a user's code took part.

    Raises:
        VlatoolError: what the stage raises; SourceError, or GraphError of an engine, when the child ends before it is
            done.
        BundleError: when what it wrote is not a whole bundle.
    """
    job, whose = {**_job(stage, source, context), "out": str(draft)}, factory_of(source)
    about, preload = whose or stage.name(), (*PRELOAD, *stage.imports) if whose else child_imports(stage)
    answer = children.call("vlatool.stage._child:run", job, context.progress, about, preload, own=not whose)
    messages = answer if isinstance(answer, list) else []  # a policy may have answered
    return Result(Bundle.open(draft, verify=bool(whose)), tuple(map(str, messages)))


def run(job: Mapping[str, Any], tell: OnProgress) -> list[str]:
    """Run the stage of a job in this process; return its messages."""
    stage = _stage_of(job, Transform)
    source = Bundle.open(Path(job["source"]), verify=False) if job["source"] else None
    with _name_plugin():
        return list(stage.run(cast(Bundle, source), Path(job["out"]), Context(tell, **job["context"])).messages)


def measure_in_child(environment: Mapping[str, str], stage: Measure, source: Bundle, context: Context) -> Report:
    """Run a measuring stage in a child process that has further variables from its start."""
    job, settings = _job(stage, source, context), " ".join(f"{name}={value}" for name, value in environment.items())
    about = f"{stage.name()} with {settings}" if settings else stage.name()
    here, preload = "vlatool.stage._child:measure", child_imports(stage)
    answer = children.call(here, job, context.progress, about, preload, environment, own=True)
    for sentence in answer["notes"]:
        context.note(str(sentence))
    return Report.from_json(str(answer["report"]))


def measure(job: Mapping[str, Any], tell: OnProgress) -> dict[str, Any]:
    """Run the measuring stage of a job in this process; return its report as JSON, and its notes."""
    stage, notes = _stage_of(job, Measure), list[str]()
    source = Bundle.open(Path(job["source"]), verify=False)
    with _name_plugin():
        report = stage.run(source, Context(tell, **job["context"], note=notes.append)).to_json()
    return {"report": report, "notes": notes}


def _job(stage: Stage, source: Bundle | None, context: Context) -> dict[str, Any]:
    """Return what a child needs to know of a stage."""
    return {
        "stage": stage.name(), "options": stage.explicit_options(),
        "source": str(source.path.absolute()) if source else "",
        "context": {name: getattr(context, name) for name in CHILD_FIELDS},
    }  # fmt: skip


def _stage_of(job: Mapping[str, Any], kind: type[AnyStage]) -> AnyStage:
    """Return the stage of a job, which makes bundles or measures, as its caller takes for granted."""
    stage = build_stage(job["stage"], job["options"])
    if not isinstance(stage, kind):
        raise RecipeError(f"The stage {job['stage']} is not a {kind.__name__}.", "name another stage")
    return stage


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
