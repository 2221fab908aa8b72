"""``vlatool record``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool.cli._document import answer
from vlatool.cli._options import (
    AsJson,
    BundleEngine,
    BundlePath,
    Controllers,
    Neutral,
    RobotName,
    StepDeadline,
    Threads,
)


def record(
    bundle: BundlePath,
    output: Annotated[Path, typer.Option("-o", "--output", help="new file", show_default=False)],
    robot: RobotName = "",
    deadline_ms: StepDeadline = None,
    fallback: Annotated[
        Path | None, typer.Option(help="bundle that acts where this one has no action in time", show_default=False)
    ] = None,
    neutral: Neutral = "",
    controller: Controllers = "",
    engine: BundleEngine = "",
    threads: Threads = None,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="control steps")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="seed of the noise")] = 0,
    as_json: AsJson = False,
) -> None:
    """Record control steps of a bundle and its layers on this machine, to compute them again with replay.

    No robot moves; on a robot, load(..., record=FILE) records the same.
    """
    from vlatool.measurement.recorded_run import record_run

    found = record_run(
        bundle,
        output,
        robot=robot,
        deadline_ms=deadline_ms,
        fallback=fallback,
        neutral=neutral,
        controllers=[name for name in controller.split(",") if name],
        engine=engine,
        threads=threads,
        steps=steps,
        seed=seed,
    )
    answer(as_json, found.to_dict(), [f"{found.file}: {found.steps} control steps, {found.bytes / 1e6:.3g} MB"])
