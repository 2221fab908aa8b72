"""Example inputs of each module of a policy."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for, recordings_of
from vlatool.errors import require
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.runtime.observation import ObservationEncoder

if TYPE_CHECKING:
    from torch import Tensor, nn


def recorded_inputs(bundle: Bundle, count: int) -> list[dict[str, Tensor]]:
    """Return recorded observations (or synthetic ones) as modules are given them: value name -> (1, ...)."""
    torch = require("torch", "build")
    encode = ObservationEncoder(bundle.manifest.spec, bundle)
    return [
        {name: torch.from_numpy(np.array(value)) for name, value in encode(observation).items()}
        for observation in observations_for(bundle, count)
    ]


def unrecorded_note(bundle: Bundle, count: int) -> tuple[str, ...]:
    """Say that a choice rests on random observations, where nothing is recorded."""
    if recordings_of(bundle).calibration is not None:
        return ()
    words = f"nothing is recorded: chosen by {count} random observations, which are none that the robot meets"
    return (f"{words}; record some, and name them in policy.yaml (calibration: FILE.npz)",)


def first_feeds(modules: Mapping[str, nn.Module], bundle: Bundle) -> dict[str, list[Tensor]]:
    """Run a policy on its first observation; return graph name -> what its module is given first, in order.

    Raises:
        SourceError: when a module fails.
    """
    torch = require("torch", "build")
    program = BatchedProgram(bundle.manifest.program, modules)
    given: dict[str, list[Any]] = {}

    def note(graph: str) -> Any:
        def look(_module: Any, arguments: tuple[Any, ...]) -> None:
            given.setdefault(graph, [argument.clone() for argument in arguments])

        return look

    with contextlib.ExitStack() as hooks, torch.no_grad():
        for graph, module in modules.items():
            hooks.callback(module.register_forward_pre_hook(note(graph)).remove)
        program.run(recorded_inputs(bundle, 1)[0], draw_noise(program.noise, 1, np.random.default_rng(0)))
    return given
