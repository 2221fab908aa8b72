"""The interpreter of a bundle's program: order, repeats, carried tensors, schedules, noise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError, nearest
from vlatool.manifest import ProgramStep

Array = NDArray[Any]


Run = Callable[[Mapping[str, Any]], Mapping[str, Any]]


class Session(Protocol):
    """One open graph on one engine."""

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array."""


class Program:
    """Runs the steps of a program over open sessions.

    Args:
        steps: As in the manifest.
        sessions: Graph name -> open session.
        seed: Seed of the noise; fresh entropy when None.
    """

    def __init__(self, steps: Iterable[ProgramStep], sessions: Mapping[str, Session], seed: int | None = None) -> None:
        self.steps = tuple(steps)
        self.sessions = sessions
        self._seed = seed
        self._schedules = [_schedules(step) for step in self.steps]
        self._plain = self._plain_step()
        self.reset()

    def _plain_step(self) -> tuple[Run, list[tuple[str, str]], list[tuple[str, str]]] | None:
        """The parts of a program that is one graph, run once, with nothing beside inputs and outputs."""
        if len(self.steps) != 1:
            return None
        step = self.steps[0]
        if step.repeat != 1 or step.sources() or step.carry:
            return None
        return self.sessions[step.graph].run, list(step.feeds.items()), list(step.gives.items())

    def reset(self) -> None:
        """Zero the kept values and restart the noise from the seed."""
        self._random = np.random.default_rng(self._seed)
        self._kept = {
            name: np.zeros(kept["shape"], kept.get("dtype", "float32"))
            for step in self.steps
            for name, kept in step.keep.items()
        }

    def run(self, values: dict[str, Any], noise: Mapping[str, Array] | None = None) -> dict[str, Any]:
        """Run all steps and return every value; ``values`` (the encoded inputs) is filled in place.

        Args:
            values: Value name -> array.
            noise: Value name -> array, in the place of what the program would draw.
        """
        for name in noise or ():
            if all(name not in step.noise for step in self.steps):
                known = [known for step in self.steps for known in step.noise]
                raise DataError(f"The program draws no noise '{name}'; {nearest(name, known)}.")
        if self._plain is not None:
            run, feeds, gives = self._plain
            given = run({name: values[value] for name, value in feeds})
            for name, value in gives:
                values[value] = given[name]
            return values
        values.update(self._kept)
        for step, schedules in zip(self.steps, self._schedules, strict=True):
            for name, wanted in step.noise.items():
                values[name] = self._draw(name, wanted, noise)
            self._run_step(step, schedules, values)
        for name in self._kept:
            self._kept[name] = values[name]
        return values

    def _run_step(self, step: ProgramStep, schedules: dict[str, list[Array]], values: dict[str, Any]) -> None:
        session = self.sessions[step.graph]
        for turn in range(step.repeat):
            for name, numbers in schedules.items():
                values[name] = numbers[turn]
            given = session.run({name: values[value] for name, value in step.feeds.items()})
            for name, value in step.gives.items():
                values[value] = given[name]
            for source, target in step.carry.items():
                values[target] = values[source]

    def _draw(self, name: str, wanted: Mapping[str, Any], noise: Mapping[str, Array] | None) -> Array:
        shape = tuple(wanted["shape"])
        if noise is not None and name in noise:
            if noise[name].shape != shape:
                raise DataError(f"The noise '{name}' has the shape {list(noise[name].shape)}; wanted {list(shape)}.")
            return np.asarray(noise[name], np.float32)
        return draw(wanted, self._random)


def draw(wanted: Mapping[str, Any], random: np.random.Generator) -> Array:
    """Draw float32 noise as a program asks for it: ``normal`` N(0, 1), ``uniform`` on [-1, 1) or ``zeros``."""
    shape = tuple(wanted["shape"])
    distribution = wanted.get("distribution", "normal")
    if distribution == "zeros":
        return np.zeros(shape, np.float32)
    if distribution == "uniform":
        return random.uniform(-1, 1, shape).astype(np.float32)
    return random.standard_normal(shape, np.float32)


def _schedules(step: ProgramStep) -> dict[str, list[Array]]:
    found = {}
    for name, numbers in step.schedule.items():
        whole = all(isinstance(number, int) for number in numbers)
        found[name] = [np.array([number], np.int64 if whole else np.float32) for number in numbers]
    return found
