"""``vlatool record``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool.cli import _complete
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, BundlePath


def record(
    bundle: BundlePath,
    output: Annotated[Path, typer.Option("-o", "--output", help="new file", show_default=False)],
    robot: Annotated[str, typer.Option(help="robot whose limits no action leaves; none when not given")] = "",
    deadline_ms: Annotated[
        float | None,
        typer.Option("--deadline-ms", help="ms in which a control step is answered; the control period when not given"),
    ] = None,
    fallback: Annotated[
        Path | None, typer.Option(help="bundle that acts where this one has no action in time", show_default=False)
    ] = None,
    neutral: Annotated[str, typer.Option(help="label of the discrete action without motion")] = "",
    controller: Annotated[str, typer.Option(help="controller and wrappers, by name, with commas between")] = "",
    engine: Annotated[
        str, typer.Option(help="engine; the bundle's when not given", autocompletion=_complete.engines)
    ] = "",
    threads: Annotated[int | None, typer.Option(min=1, help="threads; all cores when not given")] = None,
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
