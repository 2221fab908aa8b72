"""Feature distillation: an objective that also compares the outputs of blocks of student and teacher."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, SourceError, require
from vlatool.files.printable import amount
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.module.feeds import recorded_inputs
from vlatool.training.device import device_in_use
from vlatool.training.matching import Pair, Stack, pairs_of
from vlatool.training.objective import Objective
from vlatool.training.rounds import NOISE, tensors
from vlatool.training.taps import BlockName, Form, Taps
from vlatool.training.teacher import Teacher

if TYPE_CHECKING:
    from torch import Tensor, nn

PROJECTIONS = "(hints)"
"""Under what the projections are trained, beside the graphs of the student."""
Forms = Mapping[BlockName, Form]
Outputs = Mapping[BlockName, "Tensor"]


@dataclass(frozen=True)
class Hint:
    """A term of the loss.

    Args:
        name: name of the option that gives its weight.
        distance: features of the student and of the teacher, (N, ..., D) -> their distance, a mean over rows.
        left_out: stack -> why it is not compared.
        projections: number of a pair -> what brings the student's features to the teacher's width.
    """

    name: str
    weight: float
    distance: Callable[[Tensor, Tensor], Tensor]
    pairs: Sequence[Pair]
    left_out: Mapping[Stack, str]
    projections: nn.ModuleDict

    def __call__(self, ours: Outputs, theirs: Outputs) -> Any:
        """Return the mean over all pairs, times the weight."""
        terms = [self._distance(str(number), pair, ours, theirs) for number, pair in enumerate(self.pairs)]
        return self.weight * sum(terms) / len(terms)

    def _distance(self, number: str, pair: Pair, ours: Outputs, theirs: Outputs) -> Tensor:
        student, teacher = ours[pair.ours], theirs[pair.theirs]
        if number in self.projections:
            student = self.projections[number](student)
        if student.shape[:-1] != teacher.shape[:-1]:
            raise SourceError(
                f"For a batch, the block '{pair.ours[1]}' gives {list(student.shape)}, the teacher's "
                f"'{pair.theirs[1]}' {list(teacher.shape)}; for one observation they agreed.",
                f"let both have the batch in front, or leave --{self.name} out",
            )
        return self.distance(student, teacher)

    def about(self) -> dict[str, Any]:
        """Return what is compared with what, as JSON values."""
        blocks = [[*pair.stack, *pair.numbers] for pair in self.pairs]
        left_out = [[*stack, why] for stack, why in self.left_out.items()]
        return {"weight": self.weight, "blocks": blocks, **({"left_out": left_out} if left_out else {})}


def with_hints(
    base: Objective, weights: Mapping[str, float], student: BatchedProgram, source: Bundle, teacher: Teacher, seed: int
) -> Objective:
    """Return an objective with further terms; the objective itself where all weights are 0.

    The teacher runs on the same rows and the same noise as the student, in the same precision, without gradients.

    Args:
        base: its loss runs the student once on the rows that it is given.
        weights: name of a hint -> its weight in the loss.

    Raises:
        RecipeError: when there is nothing to compare.
        SourceError: when student or teacher fails.
    """
    asked = {name: weight for name, weight in weights.items() if weight}
    if not asked:
        return base
    pairs = pairs_of(student.modules, source, teacher)
    if not pairs:
        raise RecipeError(
            f"{source.manifest.name} and its teacher have no stack of blocks in common (an nn.ModuleList or "
            f"nn.Sequential of modules of one class, of the same name in both), so --{' and --'.join(asked)} "
            "would compare nothing.",
            f"leave --{' and --'.join(asked)} out",
        )
    ours, theirs = Taps(student, (pair.ours for pair in pairs)), Taps(teacher.program, (pair.theirs for pair in pairs))
    forms = _forms(ours, theirs, source)
    hints = [_hint(name, weight, pairs, forms, seed) for name, weight in asked.items()]

    def loss(rows: Mapping[str, Any]) -> Tensor:
        size = len(next(iter(rows.values())))
        _probe_batching(rows, student, teacher.program)
        with ours.open(size):
            far = base.loss(rows)
        with require("torch", "build").no_grad(), theirs.open(size):
            teacher.program.run(tensors(rows), tensors(rows, NOISE))
        whole: Tensor = far + _sum(hints, ours.take(size), theirs.take(size))
        return whole

    nn = require("torch", "build").nn
    along = {PROJECTIONS: nn.ModuleDict({hint.name: hint.projections for hint in hints})}
    name = ", ".join([base.name, *(f"{hint.weight:g} {hint.name}" for hint in hints)])
    about = {"hints": {hint.name: hint.about() for hint in hints}}
    return replace(base, name=name, loss=loss, judged=base.loss, along=along, about={**base.about, **about})


def _probe_batching(rows: Mapping[str, Any], *programs: BatchedProgram) -> None:
    """Let programs find out in float32 whether they take batches, before anything is kept of them."""
    with device_in_use().casting(enabled=False):
        for program in programs:
            program.look(tensors(rows), tensors(rows, NOISE))


def _sum(hints: Sequence[Hint], ours: Outputs, theirs: Outputs) -> Any:
    with device_in_use().casting(enabled=False):
        return sum(hint(ours, theirs) for hint in hints)


def _forms(ours: Taps, theirs: Taps, source: Bundle) -> tuple[Forms, Forms]:
    """Return what the blocks of student and teacher give for one observation."""
    inputs = recorded_inputs(source, 1)[0]
    noise = draw_noise(ours.program.noise, 1, np.random.default_rng(0))
    return ours.forms(inputs, noise), theirs.forms(inputs, noise)


def _hint(name: str, weight: float, pairs: Sequence[Pair], forms: tuple[Forms, Forms], seed: int) -> Hint:
    """Return a hint over all stacks that it can compare."""
    kind = registry.load("hints", name)()
    left_out: dict[Stack, str] = {}
    for pair in pairs:
        if why := _mismatch(forms[0][pair.ours], forms[1][pair.theirs], kind):
            left_out.setdefault(pair.stack, why)
    compared = [pair for pair in pairs if pair.stack not in left_out]
    if not compared:
        reasons = "; ".join(f"{stack or 'the module itself'}: {why}" for (_, stack), why in left_out.items())
        raise RecipeError(f"--{name} can compare no stack of blocks: {reasons}.", f"leave --{name} out")
    projections = _projections(compared, forms, seed) if kind.projects else require("torch", "build").nn.ModuleDict()
    return Hint(name, weight, kind, compared, left_out, projections)


def _mismatch(ours: Form, theirs: Form, kind: Any) -> str:
    """Return why what two blocks give cannot be compared, empty where it can."""
    if not ours.calls or not theirs.calls:
        return "its blocks are not called as modules"
    if ours.calls != theirs.calls:
        return f"the student runs its blocks {amount(ours.calls, 'time')} in an inference, the teacher {theirs.calls}"
    if ours.shape is None or theirs.shape is None:
        return "its blocks do not give a tensor of floats, always of the same shape"
    if ours.features[:-1] != theirs.features[:-1]:
        return f"the student's blocks give {list(ours.shape)}, the teacher's {list(theirs.shape)}"
    reasons = (kind.why_not(form.shape, form.channels_first) for form in (ours, theirs))
    return next(filter(None, reasons), "")


def _projections(pairs: Iterable[Pair], forms: tuple[Forms, Forms], seed: int) -> nn.ModuleDict:
    """Return a linear map for each pair of different widths, which keeps the size of what is normalised."""
    torch = require("torch", "build")
    made: nn.ModuleDict = torch.nn.ModuleDict()
    for number, pair in enumerate(pairs):
        width, wanted = forms[0][pair.ours].features[-1], forms[1][pair.theirs].features[-1]
        if width != wanted:
            random = torch.Generator().manual_seed(seed * 1000 + number)
            made[str(number)] = projection = torch.nn.utils.skip_init(torch.nn.Linear, width, wanted, bias=False)
            with torch.no_grad():
                projection.weight.normal_(std=width**-0.5, generator=random)
    return made
