"""``vlatool compare``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.cli import _complete
from vlatool.cli._console import progress, refuse_existing, show
from vlatool.cli._options import AsJson, Force, Raw, ReportFolder
from vlatool.compare.inputs import read_reports
from vlatool.compare.side_by_side import side_by_side
from vlatool.errors import DataError, UsageError


def compare(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="two or more bundles, or two or more reports", show_default=False, autocompletion=_complete.reports
        ),
    ],
    output: ReportFolder = None,
    iterations: Annotated[int, typer.Option(min=20, help="timed inferences of each bundle")] = 200,
    threads: Annotated[int, typer.Option(min=1, help="intra-op threads")] = 1,
    force: Force = False,
    as_json: AsJson = False,
    raw: Raw = False,
) -> None:
    """Compare bundles in one interleaved run, or put reports side by side. The first is the baseline.

    Reports that were made on other machines, with other engines, threads or clocks are put side by side with a warning
    that names what differs; a speed-up across reports is given for the same machine only.
    """
    from vlatool.benchmark.latency import Latency

    if len(paths) < 2:
        raise UsageError(
            "compare needs two or more bundles, or two or more reports.",
            "name them one after the other: vlatool compare ONE OTHER",
        )
    refuse_existing(output, force, *paths)
    for path in paths:
        if not path.exists():
            raise DataError(
                f"No report or bundle at {path}.",
                "check the path; a report is report.json or the directory that holds it",
            )
    bundles = [(path / MANIFEST).is_file() for path in paths]
    if all(bundles):
        with progress() as context:
            stage = Latency(against=tuple(paths[1:]), iterations=iterations, threads=threads, duration=0)
            stage.check(None, None)
            report = replace(stage.run(Bundle.open(paths[0]), context), kind="compare")
    elif any(bundles):
        raise UsageError(
            "compare takes bundles or reports, not both at once.",
            "measure the bundles first (vlatool benchmark latency -o DIR); or name bundles alone",
        )
    else:
        report = side_by_side(paths, read_reports(paths))
    show(report, as_json=as_json, out=output, force=force, raw=raw)
