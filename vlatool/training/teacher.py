"""Who says what a student should have done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, SourceError
from vlatool.module.batched import BatchedProgram
from vlatool.module.edits import Edit, read_edits
from vlatool.module.origin import origin_of
from vlatool.module.torch_policy import load_modules, unedited_modules

if TYPE_CHECKING:
    from torch import nn


@dataclass(frozen=True)
class Teacher:
    """A policy in torch that fits the student's.

    Args:
        bundle: Its source bundle.
        edits: What was done to its structure.
        program: Its modules, and how they run.
    """

    bundle: Bundle
    edits: tuple[Edit, ...]
    program: BatchedProgram

    @classmethod
    def of(cls, student: Bundle, path: Path | None, modules: Mapping[str, nn.Module]) -> Teacher:
        """Open the teacher of a student.

        Args:
            student: The student's bundle.
            path: The teacher's bundle; what the student was before any edit when None.
            modules: The student's, which the teacher's must not share weights with.

        Raises:
            RecipeError: when it is exported, takes or gives something else, or is the student.
            SourceError: when its modules are the student's own.
        """
        bundle, edits = student, tuple[Edit, ...]()
        if path is not None:
            bundle = Bundle.open(path)
            if bundle.manifest.graphs or "factory" not in bundle.manifest.source:
                raise RecipeError(
                    f"{path} has no torch modules that could teach: it is exported, or an ONNX file.",
                    "name the bundle that it was exported from",
                )
            if bundle.hash == student.hash:
                raise RecipeError(f"{path} is the student itself.", "name another teacher")
            edits = read_edits(bundle)
        own = load_modules(bundle) if path is not None else unedited_modules(bundle)
        _check_apart(own, modules)
        _check_fits(bundle, student)
        program = bundle.manifest.program if path is not None else origin_of(bundle).program
        return cls(bundle, edits, BatchedProgram(program, own))


def _check_apart(teacher: Mapping[str, nn.Module], student: Mapping[str, nn.Module]) -> None:
    """Refuse modules that share weights: the teacher would change with the student."""
    weights = [{value.data_ptr() for module in each.values() for value in module.parameters()}
               for each in (teacher, student)]  # fmt: skip
    if weights[0] & weights[1]:
        raise SourceError(
            "The factory gives the same module each time that it is called: what is done to the student is done to "
            "its teacher, too.",
            "let it make a new module each time",
        )


def _check_fits(teacher: Bundle, student: Bundle) -> None:
    """Refuse a teacher that sees or does something else."""
    for ours, theirs, what in (
        (student.manifest.spec.inputs, teacher.manifest.spec.inputs, "is given"),
        (student.manifest.spec.outputs, teacher.manifest.spec.outputs, "gives"),
    ):
        wanted = {tensor.name: (tensor.kind, tensor.shape, tensor.dtype, tensor.labels) for tensor in ours}
        other = {tensor.name: (tensor.kind, tensor.shape, tensor.dtype, tensor.labels) for tensor in theirs}
        for name in sorted({*wanted, *other}):
            if wanted.get(name) != other.get(name):
                raise RecipeError(
                    f"The teacher {what} '{name}' as {_shown(other.get(name))}, the student as "
                    f"{_shown(wanted.get(name))}; they must agree.",
                    "take a teacher with the same inputs and outputs",
                )


def _shown(tensor: Any) -> str:
    return "nothing" if tensor is None else f"{tensor[0]} {list(tensor[1])} {tensor[2]}"
