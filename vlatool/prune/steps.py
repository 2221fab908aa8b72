"""Fewer denoising steps: a flow-matching head integrates in larger steps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.errors import RecipeError
from vlatool.files.printable import amount
from vlatool.hardware.profile import Profile
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import nn

ROUNDING_TOLERANCE = 1e-6
"""Largest relative difference of equal numbers in a schedule after rounding."""


class Steps(ModuleStage):
    """Repeat the graph of a denoising loop fewer times, with larger steps.

    For policies that integrate a flow (Euler steps) and whose program has both schedules: evenly spaced times, and a
    constant step size. ``[1.0, 0.9, ..., 0.1]`` and ``[-0.1, ...]`` become ``[1.0, 0.5]`` and ``[-0.5, -0.5]``. Weights
    stay; ``vlatool distill policy`` then trains the policy to reach the same result in fewer steps.
    """

    keeps_weights: ClassVar[bool] = True

    to: int = Field(ge=1, le=1000, description="steps to keep")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that the program repeats a graph, in steps that can be larger."""
        super().check(source, profile)
        if source is not None:
            self._program(source.manifest.program)

    def in_parts(self) -> bool:
        """Return True: no weight is needed."""
        return True

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Change the program alone."""
        before, program = source.manifest.program, self._program(source.manifest.program)
        changed = (
            f"steps of '{old.graph}': {old.repeat} -> {new.repeat}"
            for old, new in zip(before, program, strict=True) if old != new
        )  # fmt: skip
        return ModuleChanges(program=program, messages=tuple(changed))

    def _program(self, steps: Sequence[ProgramStep]) -> tuple[ProgramStep, ...]:
        if all(step.repeat == 1 for step in steps):
            raise RecipeError("The policy has no denoising steps: its program repeats no graph.", "use another method")
        return tuple(with_fewer_steps(step, self.to) if step.repeat > 1 else step for step in steps)


def with_fewer_steps(step: ProgramStep, count: int) -> ProgramStep:
    """Return a step of a program that repeats its graph ``count`` times, over the same span of time.

    Raises:
        RecipeError: when it already has no more steps, or its schedule is not evenly spaced.
    """
    if count >= step.repeat:
        raise RecipeError(
            f"The program repeats '{step.graph}' {amount(step.repeat, 'time')}; --to is {count}.", "ask for fewer steps"
        )
    sizes = {name: numbers[0] for name, numbers in step.schedule.items() if _is_even(numbers, 0.0)}
    times = {name: numbers[1] - numbers[0] for name, numbers in step.schedule.items() if name not in sizes}
    uneven = [name for name in times if not _is_even(step.schedule[name], times[name])]
    if uneven:
        raise RecipeError(
            f"The schedule of '{uneven[0]}' is neither constant nor evenly spaced; for fewer steps it is unknown.",
            "write the program with fewer steps in policy.yaml",
        )
    if not any(
        math.isclose(abs(size), abs(spacing), rel_tol=1e-3) for size in sizes.values() for spacing in times.values()
    ):
        raise RecipeError(
            f"The program of '{step.graph}' has no schedule of the step size, the distance between two times "
            f"({', '.join(f'{name}: {spacing:.3g}' for name, spacing in times.items()) or 'no times'}).",
            "give the graph the size of its step as an input: schedule: {dt: [-0.1, ...]}",
        )
    larger = step.repeat / count
    schedule = {name: [size * larger] * count for name, size in sizes.items()} | {
        name: [step.schedule[name][0] + spacing * larger * turn for turn in range(count)]
        for name, spacing in times.items()
    }
    stored = {name: _as_stored(step, name, schedule[name]) for name in step.schedule}
    return replace(step, repeat=count, schedule=stored)


def _as_stored(step: ProgramStep, name: str, numbers: list[float]) -> list[float]:
    """Return numbers for a schedule, as integers where the original ones are, since a graph takes them as integers."""
    if not all(isinstance(number, int) for number in step.schedule[name]):
        return numbers
    if any(abs(number - round(number)) > ROUNDING_TOLERANCE for number in numbers):
        raise RecipeError(
            f"The schedule of '{name}' has integers; with {amount(len(numbers), 'step')} instead of {step.repeat} they "
            "would become fractions.",
            f"ask for a divisor of {step.repeat}",
        )
    return [round(number) for number in numbers]


def _is_even(numbers: Sequence[float], spacing: float) -> bool:
    """Return whether the numbers are evenly spaced."""
    scale = ROUNDING_TOLERANCE * max(map(abs, numbers), default=0.0)
    return all(abs(after - before - spacing) <= scale for before, after in itertools.pairwise(numbers))
