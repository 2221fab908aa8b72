"""What the commands on a store have in common: where it is, and what is shown of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlatool.errors import UsageError

if TYPE_CHECKING:
    from vlatool.deployment.deploy import Conditions
    from vlatool.stage.base import OnProgress

Target = Annotated[
    str | None,
    typer.Argument(metavar="[USER@HOST]", help="robot, as ssh takes it; this machine if unset", show_default=False),
]
StoreFolder = Annotated[
    str,
    typer.Option(metavar="DIR", help="directory of the store; $VLATOOL_STORE or ~/.local/share/vlatool/store if unset"),
]
TargetPython = Annotated[
    str, typer.Option(metavar="PATH", help="Python on the robot; the first that has numpy and the engine if unset")
]
HASH_CHARACTERS = 19


def perform_on(
    target: str | None,
    action: str,
    store: str,
    tell: OnProgress,
    *,
    bundle: Path | None = None,
    conditions: Conditions | None = None,
    python: str = "",
) -> dict[str, Any]:
    """Do something with a store, here or on a target, and return its status."""
    from vlatool.deployment.deploy import Conditions
    from vlatool.remote.deployment import change_on
    from vlatool.remote.deployment_agent import DeploymentJob, perform

    if target is not None:
        return change_on(target, action, store, tell, bundle=bundle, conditions=conditions, python=python)
    if python:
        raise UsageError("--remote-python is the Python of a robot.", "name it: user@host")
    bundles = () if bundle is None else (str(bundle),)
    return perform(DeploymentJob(action, store, conditions or Conditions(), bundles=bundles), tell)


def lines(found: Mapping[str, Any]) -> list[str]:
    """Return the status of a store, a line each."""
    shown = [f"{found['store']}: slot {found['active']} is active{_trial(found['trial'])}"]
    for name, slot in sorted(found["slots"].items()):
        release = f"  release {slot['release']}" if slot["release"] else ""
        state = f"DAMAGED: {slot['problem']}" if slot["problem"] else "every file verified"
        shown.append(
            f"  {name}  {slot['name']} {slot['version']}{release}  {slot['bundle'][:HASH_CHARACTERS]}  {state}"
        )
    shown += [f"  required key   {key}" for key in found["required_keys"]]
    shown += [f"  last rollback  {found['last_rollback']}"] if found["last_rollback"] else []
    return shown


def _trial(trial: Mapping[str, Any] | None) -> str:
    if trial is None:
        return ""
    return f", on trial for {trial['ticks']} inferences and {trial['seconds']:g} s, {trial['starts']} starts so far"
