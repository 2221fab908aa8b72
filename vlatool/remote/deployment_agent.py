"""What changes a store on a target: ``python -m vlatool.remote.deployment_agent``; it needs numpy and an engine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.deployment.deploy import Conditions, OnProgress, deploy, roll_back, status
from vlatool.deployment.store import Store, default_store
from vlatool.measurement import child

RECORDING = "files/recording.npz"
"""Path of the recording below the directory of the run."""


@dataclass(frozen=True)
class DeploymentJob:
    """A change of a store.

    Args:
        action: ``deploy``, ``rollback`` or ``status``.
        store: directory of the store; the default one when empty.
        conditions: conditions of a deployment.
        engine: engine of the target.
        bundles: the bundle to deploy, if any.
    """

    action: str
    store: str
    conditions: Conditions
    engine: str = ""
    bundles: tuple[str, ...] = ()


def perform(job: DeploymentJob, tell: OnProgress) -> dict[str, Any]:
    """Do what a job says, and return the status of the store; raises what ``vlatool.deployment.deploy`` raises."""
    store = Store(Path(job.store).expanduser() if job.store else default_store())
    if job.action == "deploy":
        return deploy(store, Path(job.bundles[0]), job.conditions, tell)
    return roll_back(store) if job.action == "rollback" else status(store, store.read_deployed())


def main() -> dict[str, Any]:
    """Do the job that standard input names."""
    return perform(child.read_job(DeploymentJob), lambda what, share: child.say(child.Progress(what, share)))


if __name__ == "__main__":
    child.answer(main)
