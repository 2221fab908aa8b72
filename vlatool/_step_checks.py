"""What one entry of a program may say: types, and sizes that a machine can hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import SpecError
from vlatool.limits import check
from vlatool.spec import DTYPES
from vlatool.typed import axes, finite, known, mapping, shown, text

if TYPE_CHECKING:
    from vlatool.manifest import ProgramStep

DISTRIBUTIONS = ("normal", "uniform", "zeros")


def check_step(step: ProgramStep) -> None:
    """Refuse an entry whose words have other types, or ask for more than the limits allow.

    Raises:
        SpecError: naming the word and the graph.
    """
    text(step.graph, "The graph of a step", SpecError, empty=False)
    for word in ("feeds", "gives", "carry", "schedule", "noise", "keep"):
        if not isinstance(getattr(step, word), Mapping):
            raise SpecError(f"'{word}' of '{step.graph}' must be a mapping; got {shown(getattr(step, word))}.")
        mapping(getattr(step, word), f"'{word}' of '{step.graph}'", SpecError)
    for word in ("feeds", "gives", "carry"):
        for value in getattr(step, word).values():
            text(value, f"A value in '{word}' of '{step.graph}'", SpecError, empty=False)
    _check_repeat(step)
    for value, noise in step.noise.items():
        _check_noise(value, noise)
    for value, kept in step.keep.items():
        _check_kept(value, kept)


def drawn_and_kept(step: ProgramStep) -> int:
    """Return the elements of the noise and of the kept values of an entry that was checked."""
    return sum(axes(each["shape"], "a shape", SpecError) for each in (*step.noise.values(), *step.keep.values()))


def _check_repeat(step: ProgramStep) -> None:
    if isinstance(step.repeat, bool) or not isinstance(step.repeat, int) or step.repeat < 1:
        raise SpecError(f"The program repeats '{step.graph}' {shown(step.repeat)} times; allowed: from 1.")
    check("repeat", step.repeat, f"The step of '{step.graph}'", SpecError)
    for value, numbers in step.schedule.items():
        if not isinstance(numbers, list | tuple):
            raise SpecError(f"The schedule of '{value}' must be a list of numbers; got {shown(numbers)}.")
        if len(numbers) != step.repeat:
            got = f"{len(numbers)} numbers, but '{step.graph}' runs {step.repeat} times"
            raise SpecError(f"The schedule of '{value}' has {got}.")
        for entry in numbers:
            finite(entry, f"A number in the schedule of '{value}'", SpecError)
            if isinstance(entry, int) and not -(2**63) <= entry < 2**63:
                raise SpecError(f"The schedule of '{value}' has a number that no int64 holds.")


def _check_noise(value: str, noise: Any) -> None:
    if not isinstance(noise, Mapping):
        raise SpecError(f"The noise '{value}' must be a mapping; got {shown(noise)}.")
    known(noise, ("shape", "distribution"), f"The noise '{value}'", SpecError)
    if noise.get("distribution", "normal") not in DISTRIBUTIONS or not noise.get("shape"):
        raise SpecError(f"The noise '{value}' needs a shape and a distribution of {', '.join(DISTRIBUTIONS)}.")
    elements = axes(noise["shape"], f"the shape of the noise '{value}'", SpecError)
    check("elements", elements, f"The noise '{value}'", SpecError)


def _check_kept(value: str, kept: Any) -> None:
    if not isinstance(kept, Mapping) or not kept.get("shape"):
        raise SpecError(f"The kept value '{value}' needs a shape.")
    known(kept, ("shape", "dtype"), f"The kept value '{value}'", SpecError)
    if kept.get("dtype", "float32") not in DTYPES:
        raise SpecError(f"The kept value '{value}' has the dtype {shown(kept['dtype'])}; allowed: {', '.join(DTYPES)}.")
    elements = axes(kept["shape"], f"the shape of the kept value '{value}'", SpecError)
    check("elements", elements, f"The kept value '{value}'", SpecError)
