"""Targets inside a denoising loop: one turn of it for each row, from where the teacher stood.

A flow-matching head learns a velocity, and its loop adds velocities up. A student that is compared at the end of all
turns gets its gradient through all of them; one that is compared turn by turn learns the teacher's velocity itself, for
the cost of one turn (flow matching: Lipman et al., arXiv 2210.02747, with the teacher's velocity instead of the
data's).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import RecipeError
from vlatool.module.batched_program import BatchedProgram
from vlatool.training.device import on_device
from vlatool.training.rounds import AFTER, BEFORE, LABEL, NOISE, NUMBER, tensors

if TYPE_CHECKING:
    from torch import Tensor

    from vlatool.bundle.program import ProgramStep

CHUNK = "take the default, --targets chunk"


def flow_loss(
    student: BatchedProgram,
    distance: Callable[[Tensor, Tensor], Tensor],
    computed: Callable[[], contextlib.AbstractContextManager[Any]],
) -> Callable[[Mapping[str, Any]], Tensor]:
    """Return a loss of rows that were labelled with turns of the loop: how far the student's turn ends from there.

    It is multiplied by the number of turns: as far as the end would be from the teacher's if all turns erred alike.

    Args:
        student: student with a loop like the teacher's (``check_loops``).
        distance: distance of the student's values (B, ...) from the teacher's, a mean over rows.
        computed: function that returns the context in which the student computes.
    """
    loop = student.loop
    if loop is None:
        raise ValueError("a program with a loop is compared turn by turn")

    def loss(rows: Mapping[str, Any]) -> Tensor:
        student.look(tensors(rows), tensors(rows, NOISE))
        with computed():
            values = student.turn(tensors(rows), tensors(rows, LABEL + BEFORE), on_device(rows[LABEL + NUMBER]))
        after = tensors(rows, LABEL + AFTER)
        far: Tensor = sum(distance(values[name].float(), wanted) for name, wanted in after.items())  # type: ignore[assignment]
        return loop.repeat * far

    return loss


def check_loops(student: BatchedProgram, teacher: BatchedProgram, action: str, name: str) -> None:
    """Refuse programs whose turns cannot be compared.

    Args:
        action: name of the action.

    Raises:
        RecipeError: when there is no loop, both have other ones, or something else gives the action.
    """
    ours, theirs = student.loop, teacher.loop
    if ours is None:
        raise RecipeError(f"{name} repeats no graph: --targets flow compares turns of a denoising loop.", CHUNK)
    if theirs is None or _form(ours) != _form(theirs):
        turns = f"{ours.repeat} turns, the teacher's {theirs.repeat if theirs else 'none'}"
        raise RecipeError(
            f"--targets flow compares the student's turns with the same ones of the teacher; its loop has {turns}, or "
            "another schedule.",
            "compare what comes out at the end: --targets chunk",
        )
    if action not in ours.carry and action not in ours.carry.values():
        raise RecipeError(
            f"The loop of {name} carries {', '.join(ours.carry.values())}, and something behind it makes '{action}' of "
            "that, which --targets flow would not train.",
            CHUNK,
        )


def _form(loop: ProgramStep) -> tuple[Any, ...]:
    return loop.repeat, dict(loop.carry), {name: tuple(numbers) for name, numbers in loop.schedule.items()}
