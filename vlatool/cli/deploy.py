"""``vlatool deploy``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vlatool.cli._console import progress
from vlatool.cli._deployment import StoreFolder, Target, TargetPython, lines, perform_on
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, BundlePath
from vlatool.errors import DataError


def deploy(
    bundle: BundlePath,
    target: Target = None,
    store: StoreFolder = "",
    key: Annotated[
        Path | None, typer.Option(help="public key (PEM) that must have signed it; a new store then always requires it")
    ] = None,
    downgrade_to: Annotated[
        str,
        typer.Option(metavar="HASH", help="deploy a bundle that is older than what was deployed: its hash begins so"),
    ] = "",
    new_contract: Annotated[
        bool,
        typer.Option("--new-contract", help="allow other inputs, actions or rates than those of the active bundle"),
    ] = False,
    recording: Annotated[
        Path | None,
        typer.Option(help=".npz of observations for the shadow run; the golden observations of the bundle if unset"),
    ] = None,
    runs: Annotated[int, typer.Option(min=1, max=1_000_000, help="inferences of the shadow run")] = 100,
    latency_ms: Annotated[
        float | None,
        typer.Option(
            min=0, help="limit on an inference in ms; the time between two at the control rate if unset; 0: none"
        ),
    ] = None,
    growth_mb: Annotated[float, typer.Option(min=0, help="MB by which the process may grow; 0: any")] = 256.0,
    first_run: Annotated[float, typer.Option(min=0.1, help="seconds that one inference may take")] = 60.0,
    trial_ticks: Annotated[int, typer.Option(min=0, help="inferences on the robot before it is committed")] = 1000,
    trial_seconds: Annotated[float, typer.Option(min=0, help="seconds on the robot before it is committed")] = 60.0,
    engine: Annotated[str, typer.Option(help="engine that the robot uses; that of the bundle if unset")] = "",
    threads: Annotated[int | None, typer.Option(min=1, help="threads of the engine; all cores if unset")] = None,
    remote_python: TargetPython = "",
    as_json: AsJson = False,
) -> None:
    """Deploy a bundle into the slot that is not active, try it there, and make it active at once; here or on a robot.

    Whatever fails, and at whatever instant, the active bundle stays as it was.
    """
    from vlatool.deployment.deploy import Conditions
    from vlatool.deployment.signature import public_key

    if recording is not None and not recording.is_file():
        raise DataError(f"No recording at {recording}.", "name an .npz file")
    conditions = Conditions(
        key="" if key is None else public_key(key), downgrade_to=downgrade_to, new_contract=new_contract,
        recording="" if recording is None else str(recording), runs=runs, latency_ms=latency_ms, memory_mb=growth_mb,
        first_run_s=first_run, ticks=trial_ticks, seconds=trial_seconds, engine=engine, threads=threads,
    )  # fmt: skip
    with progress() as context:
        found = perform_on(
            target, "deploy", store, context.progress, bundle=bundle, conditions=conditions, python=remote_python
        )
    answer(as_json, found, [*lines(found), _measured(found["shadow"])])


def _measured(shadow: dict[str, Any]) -> str:
    """Return a line on the shadow run."""
    times = ", ".join(f"{name} {shadow[f'{name}_ms']:.2f} ms" for name in ("p50", "p95", "worst"))
    return f"  shadow run     {shadow['runs']} inferences: {times}; growth {shadow['growth_mb']:.1f} MB"
