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
from vlatool.hardware.profile import Profile
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import nn

SAME = 1e-6
"""Relative difference of numbers in a schedule that were rounded otherwise."""


class Steps(ModuleStage):
    """Run the graph that a program repeats fewer times, with the time and the size of its steps to match.

    For policies that integrate a flow (Euler steps) and whose program says both: a ``schedule`` with the time of each
    step, evenly spaced, and one with the size of the steps, always the same. ``[1.0, 0.9, ..., 0.1]`` and
    ``[-0.1, ...]`` become ``[1.0, 0.5]`` and ``[-0.5, -0.5]``. Weights stay; ``vlatool distill policy`` then trains the
    policy to reach in few steps what it reached in many.
    """

    keeps_weights: ClassVar[bool] = True

    to: int = Field(ge=1, le=1000, description="steps that stay")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The program repeats a graph, in steps that can be larger."""
        super().check(source, profile)
        if source is not None:
            self._program(source.manifest.program)

    def in_parts(self) -> bool:
        """No weight is needed."""
        return True

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Change the program alone."""
        before, program = source.manifest.program, self._program(source.manifest.program)
        context.messages.extend(
            f"steps of '{old.graph}': {old.repeat} -> {new.repeat}"
            for old, new in zip(before, program, strict=True) if old != new
        )  # fmt: skip
        return ModuleChanges(program=program)

    def _program(self, steps: Sequence[ProgramStep]) -> tuple[ProgramStep, ...]:
        if all(step.repeat == 1 for step in steps):
            raise RecipeError("The policy repeats no graph: there are no denoising steps.", "prune something else")
        return tuple(fewer(step, self.to) if step.repeat > 1 else step for step in steps)


def fewer(step: ProgramStep, count: int) -> ProgramStep:
    """Return a step of a program that repeats its graph ``count`` times, over the same span of time.

    Raises:
        RecipeError: when it has fewer steps now, or its schedule is not that of even steps.
    """
    if count >= step.repeat:
        raise RecipeError(
            f"The program repeats '{step.graph}' {step.repeat} times; --to is {count}.", "ask for fewer steps"
        )
    sizes = {name: numbers[0] for name, numbers in step.schedule.items() if _is_even(numbers, 0.0)}
    times = {name: numbers[1] - numbers[0] for name, numbers in step.schedule.items() if name not in sizes}
    uneven = [name for name in times if not _is_even(step.schedule[name], times[name])]
    if uneven:
        raise RecipeError(
            f"The schedule of '{uneven[0]}' is neither one number nor evenly spaced; with fewer steps, it is unknown.",
            "write the program with fewer steps in policy.yaml",
        )
    if not any(
        math.isclose(abs(size), abs(apart), rel_tol=1e-3) for size in sizes.values() for apart in times.values()
    ):
        raise RecipeError(
            f"The program of '{step.graph}' does not say how large its steps are: no schedule holds the distance of "
            f"two times ({', '.join(f'{name}: {apart:.3g}' for name, apart in times.items()) or 'no times'}).",
            "give the graph the size of its step as an input: schedule: {dt: [-0.1, ...]}",
        )
    larger = step.repeat / count
    schedule = {name: [size * larger] * count for name, size in sizes.items()} | {
        name: [step.schedule[name][0] + apart * larger * turn for turn in range(count)] for name, apart in times.items()
    }
    return replace(step, repeat=count, schedule={name: _like(step, name, schedule[name]) for name in step.schedule})


def _like(step: ProgramStep, name: str, numbers: list[float]) -> list[float]:
    """Return numbers for a schedule: whole ones where those before were, since a graph takes them as integers."""
    if not all(isinstance(number, int) for number in step.schedule[name]):
        return numbers
    if any(abs(number - round(number)) > SAME for number in numbers):
        raise RecipeError(
            f"The schedule of '{name}' has whole numbers; with {len(numbers)} steps in the place of {step.repeat} they "
            "would not be.",
            f"ask for a divisor of {step.repeat}",
        )
    return [round(number) for number in numbers]


def _is_even(numbers: Sequence[float], apart: float) -> bool:
    """Return whether neighbours are all so far apart."""
    scale = SAME * max(map(abs, numbers), default=0.0)
    return all(abs(after - before - apart) <= scale for before, after in itertools.pairwise(numbers))
