"""Recorded observations as torch tensors, each with the values that the policy kept of earlier ones in its episode."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment, calibration_recording, synthetic_observations
from vlatool.errors import require
from vlatool.module.batched_program import BatchedProgram
from vlatool.module.feeds import recorded_inputs
from vlatool.runtime.observation import ObservationEncoder

if TYPE_CHECKING:
    from torch import Tensor

Values = Mapping[str, "Tensor"]
LEADING_OBSERVATIONS = 16
"""Observations, the one that counts with them, through which gradients and changes of the policy pass."""


@dataclass(frozen=True)
class Passage:
    """An observation, and those that lead to it.

    Args:
        kept: what the policy kept before the first of them, as ``BatchedProgram`` takes it; nothing at the beginning.
        inputs: inputs of each, as modules are given them: value name -> (1, ...). The last one counts.
    """

    kept: Values
    inputs: Sequence[Values]

    def run(self, program: BatchedProgram, noise: Values) -> dict[str, Tensor]:
        """Run a policy along all of them; return every value of the last run."""
        values = program.run(self.inputs[0], {**noise, **self.kept})
        for inputs in self.inputs[1:]:
            values = program.run(inputs, {**noise, **program.kept_of(values)})
        return values


def passages(bundle: Bundle, program: BatchedProgram, noise: Values, count: int, leading: int) -> list[Passage]:
    """Return recorded observations (or synthetic ones), spread over the recording.

    A policy that keeps values is run along the episodes from their beginning, once: what it keeps where a passage
    begins is exact.

    Args:
        program: the policy as it is.
        noise: what it draws, each time.
        leading: length of a passage at most; 1 for a policy that keeps nothing.
    """
    if not program.kept:
        return [Passage({}, (inputs,)) for inputs in recorded_inputs(bundle, count)]
    encode = ObservationEncoder(bundle.manifest.spec, bundle)
    found, kept = list[Passage](), dict[str, Any]()
    before: deque[tuple[Values, Values]] = deque(maxlen=leading)
    with require("torch", "build").no_grad():
        for moment in _moments(bundle, count):
            if moment.begins:
                kept = {}
                before.clear()
            before.append((kept, _tensors(encode(moment.observation))))
            if moment.counts:
                found.append(Passage(before[0][0], tuple(inputs for _, inputs in before)))
            kept = program.kept_of(program.run(before[-1][1], {**noise, **kept}))
    return found


def _moments(bundle: Bundle, count: int) -> Iterator[Moment]:
    """Yield recorded observations with all before them, or synthetic ones, which are one episode."""
    recording = calibration_recording(bundle)
    if recording is not None:
        yield from recording.with_history(recording.spread(count))
        return
    for number, observation in enumerate(synthetic_observations(bundle, count)):
        yield Moment(observation, number, begins=not number)


def _tensors(values: Mapping[str, Any]) -> dict[str, Tensor]:
    torch = require("torch", "build")
    return {name: torch.from_numpy(np.array(value)) for name, value in values.items()}
