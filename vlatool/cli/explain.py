"""``vlatool explain``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool.bundle.bundle import Bundle
from vlatool.cli._console import progress, refuse_existing, show
from vlatool.cli._options import AsJson, BundlePath, Force, MapNames, ReportFolder


def explain(
    bundle: BundlePath,
    baseline: Annotated[
        Path | None, typer.Option(help="float32 bundle that it was made from; searched for in the cache when not given")
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="recorded observations to measure errors on; the bundle's own when not given")
    ] = None,
    map_names: MapNames = None,
    samples: Annotated[int, typer.Option(min=1, help="observations at most, spread over the recording")] = 16,
    threads: Annotated[int, typer.Option(min=1, help="intra-op threads")] = 1,
    seconds: Annotated[
        float, typer.Option(min=1, help="time limit for measuring the layers, with fewer observations if necessary")
    ] = 300.0,
    suggest: Annotated[bool, typer.Option(help="build and measure candidates for an improvement")] = True,
    output: ReportFolder = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Show which layers cost accuracy, where the time goes, what fell back, and what to do about it."""
    from vlatool.data import named_recording
    from vlatool.explain import Options
    from vlatool.explain.child_process import explain_in_child

    refuse_existing(output, force, bundle, baseline, data)
    named_recording(data, map_names or ())
    with progress() as context:
        options = Options(
            baseline, data, samples, threads=threads, suggest=suggest, seconds=seconds, map=tuple(map_names or ())
        )
        report = explain_in_child(Bundle.open(bundle), options, context)
    show(report, as_json=as_json, out=output, force=force)
