"""Deployment to another machine, through the user's own ``ssh``: the same steps as on this one, done there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.deployment.deploy import Conditions
from vlatool.files.messages import to_json
from vlatool.remote.deployment_agent import RECORDING, DeploymentJob
from vlatool.remote.ssh import Task, run_on
from vlatool.stage.base import OnProgress

AGENT = "vlatool.remote.deployment_agent"


def change_on(
    target: str,
    action: str,
    store: str,
    tell: OnProgress,
    *,
    bundle: Path | None = None,
    conditions: Conditions | None = None,
    python: str = "",
    ssh_options: Sequence[str] = (),
) -> dict[str, Any]:
    """Deploy, go back, or ask for the status on another machine, and return the status there.

    The bundle is sent to a private directory of the target, and all but the store is removed there afterwards.

    Args:
        target: ``user@host`` or a Host of ``~/.ssh/config``.
        action: ``deploy``, ``rollback`` or ``status``.
        store: directory of the store there; the default one of that user when empty.
        bundle: bundle to deploy.
        conditions: conditions of its deployment.
        python: Python to use on the target, see ``measure_on``.
        ssh_options: options of ssh, before vlatool's own.

    Raises:
        TargetError: when the target cannot be reached or used, or what runs there ends without a result.
        MissingExtra: when this machine lacks ssh, or the target a package.
        VlatoolError: what the step raises there, of the same class; see ``vlatool.deployment.deploy``.
    """
    named = conditions or Conditions()
    files = {RECORDING: Path(named.recording)} if named.recording else {}
    packages = ("cryptography",) if named.key else ()
    task = Task(AGENT, "deployment", "while it changed the store", packages, files)
    job = DeploymentJob(action, store, replace(named, recording=f"../{RECORDING}" if files else ""))
    plain = {**to_json(job), "engine": named.engine}
    found = run_on(
        task, target, plain, [] if bundle is None else [bundle], tell, python=python, ssh_options=ssh_options
    )
    return {name: value for name, value in found.items() if name not in ("log", "target")}
