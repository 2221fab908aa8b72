"""A stage that runs a user's code, in a child process: what ``run_transform`` asks for, and what answers there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vlatool import apart
from vlatool.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.stage import Context, Transform, build_stage

PRELOAD = ("torch", "onnx", "onnxscript", "onnxruntime", "vlatool.export.onnx", __name__)
"""What such stages need; imported once, by the server that forks the children."""


def run_apart(stage: Transform, source: Bundle | None, draft: Path, context: Context) -> Bundle:
    """Run a stage in a child process, verify what it wrote to ``draft``, and return that.

    Raises:
        VlatoolError: what the stage raises; SourceError when the child ends before it is done.
        BundleError: when what it wrote is no whole bundle.
    """
    job = {
        "stage": stage.name(), "options": stage.model_dump(mode="json"), "out": str(draft), "workers": context.workers,
        "source": str(source.path.absolute()) if source else "", "command": context.command,
    }  # fmt: skip
    apart.call("vlatool.launch._inside:run", job, context.tell, stage.runs(source), PRELOAD)
    return Bundle.open(draft)


def run(job: Mapping[str, Any], tell: Callable[[str, float | None], None]) -> dict[str, Any]:
    """Run the stage of a job in this process; return the hash of the bundle that it made."""
    stage = build_stage(job["stage"], job["options"])
    if not isinstance(stage, Transform):
        raise RecipeError(f"The stage {job['stage']} measures; it makes no bundle.")
    source = Bundle.open(Path(job["source"]), verify=False) if job["source"] else None
    made = stage.run(source, Path(job["out"]), Context(tell, job["workers"], job["command"]))
    return {"hash": made.hash}
