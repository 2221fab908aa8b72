"""Explain a bundle in a child process, since engines open it with profilers on and run graphs for the first time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError
from vlatool.explain import Options, explain, explanation
from vlatool.files.messages import from_json, to_json
from vlatool.report import Report
from vlatool.stage.base import Context
from vlatool.user_code import children

PRELOAD = ("numpy", "onnx", "onnxruntime", __name__)


def explain_in_child(bundle: Bundle, options: Options, context: Context) -> Report:
    """Return the report of ``explain``; raises as it does, and GraphError when an engine crashes the child."""
    job = {"bundle": str(bundle.path.absolute()), "options": to_json(options)}
    return Report.from_json(_call("report", job, context))


def explanation_in_child(bundle: Bundle, baseline: Bundle | None, context: Context, **limits: float) -> tuple[str, ...]:
    """Return the sentences of ``explanation``, or one with the reason why it failed.

    Args:
        baseline: The float32 bundle that it was made from.
        limits: Limits for ``explanation``.
    """
    paths = [str(each.path.absolute()) if each is not None else "" for each in (bundle, baseline)]
    try:
        return tuple(map(str, _call("sentences", {"paths": paths, "limits": limits}, context)))
    except GraphError as error:
        return (f"This could not be explained: {error.message}",)


def report(job: Mapping[str, Any], tell: children.OnProgress) -> str:
    """Explain the bundle of a job in this process; return the report as JSON."""
    options = from_json(Options, job["options"], "options")
    return explain(Bundle.open(Path(job["bundle"])), options, Context(tell)).to_json()


def sentences(job: Mapping[str, Any], tell: children.OnProgress) -> list[str]:
    """Explain the bundle of a job in a few sentences in this process."""
    bundle, baseline = (Bundle.open(Path(path), verify=False) if path else None for path in job["paths"])
    return list(explanation(bundle, baseline, Context(tell), **job["limits"])) if bundle else []


def _call(function: str, job: Mapping[str, Any], context: Context) -> Any:
    return children.call(f"{__name__}:{function}", job, context.progress, "explain", PRELOAD, own=True)
