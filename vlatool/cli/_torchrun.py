"""Commands that torchrun starts: its processes share a training, and nothing else."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vlatool.cli import _run
from vlatool.errors import UsageError
from vlatool.files.printable import amount

if TYPE_CHECKING:
    from vlatool.stage.base import Transform
    from vlatool.training.torchrun import Launch


def launch_for(command: str, *, trains: bool) -> Launch | None:
    """Return which of torchrun's processes this one is; None where torchrun did not start it.

    Args:
        command: The command as typed, for messages.
        trains: Whether the command trains.

    Raises:
        UsageError: when the command does not train.
        RecipeError: when the variables of torchrun are incomplete.
    """
    if "WORLD_SIZE" not in os.environ:
        return None
    from vlatool.training.torchrun import current_launch

    launch = current_launch()
    if launch is not None and not trains:
        raise UsageError(
            f"torchrun started {amount(launch.size, 'process')} of {command}, which runs in one.",
            "start it without torchrun, which is for vlatool distill policy, quantize qat and prune gradual; where "
            "nobody meant torchrun, unset RANK and WORLD_SIZE",
        )
    return launch


def with_processes(chosen: Mapping[str, Any], launch: Launch | None) -> dict[str, Any]:
    """Return options with torchrun's number of processes; raises UsageError when another one was asked for."""
    if launch is None:
        return dict(chosen)
    if (asked := chosen.get("processes", launch.size)) != launch.size:
        raise UsageError(
            f"torchrun started {amount(launch.size, 'process')}, and --processes asks for {asked}.",
            "leave --processes out: torchrun says how many there are",
        )
    return {**chosen, "processes": launch.size}


def train(stage: Transform, launch: Launch, source: str, **arguments: Any) -> None:
    """Run the command as torchrun's first process, or follow that one."""
    from vlatool.training.torchrun import follow, lead

    if launch.rank == 0:
        with lead(launch):
            _run.transform(stage, source, **arguments)
        return

    def check_source() -> None:
        from vlatool.sources import is_bundle, source_stage

        if not is_bundle(source):  # what is typed may run here, too
            source_stage(source)

    follow(launch, stage.name(), check_source)
