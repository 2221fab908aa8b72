"""The teacher of a training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.bundle.bundle import ASSETS, Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import BundleError, RecipeError, SourceError
from vlatool.machine import host
from vlatool.module.batched_program import BatchedProgram
from vlatool.module.edits import Edit, read_edits
from vlatool.module.origin import origin_of
from vlatool.module.source import Source, claimed_source
from vlatool.module.torch_policy import load_modules, unedited_modules
from vlatool.runtime.statistics import load_normaliser
from vlatool.stage.base import Context
from vlatool.stage.run import cached_transform
from vlatool.user_code import trust

if TYPE_CHECKING:
    from torch import nn

TEACHES = "name a policy (a folder with a policy.yaml), or a bundle that vlatool prune or distill wrote"


def teacher_bundle(path: Path) -> Bundle:
    """Return the source bundle of a teacher; that of a policy is made in the cache.

    Raises:
        BundleError: when there is none.
        SourceError: when it is a policy whose folder was neither named nor trusted.
    """
    source = _checked_source(path)
    if source is None:
        return Bundle.open(path)
    return cached_transform(source, None, host.cache_directory(), Context()).bundle


def check_teacher(path: Path) -> None:
    """Refuse a teacher that is not there, before anything is made for it to teach.

    Raises:
        BundleError: when it is neither a bundle nor a policy.
        SourceError: as ``teacher_bundle``, and for a policy that is wrong.
    """
    if _checked_source(path) is not None:
        return
    try:
        Bundle.open_lazily(path)
    except BundleError as error:
        raise BundleError(f"The teacher cannot be opened: {error.message}", TEACHES) from error


def _checked_source(path: Path) -> Source | None:
    """Return the source of a teacher that is a policy, whose code may run."""
    source = claimed_source(path)
    if source is not None:
        described = source.describe()
        if described is not None and not described.graphs:
            trust.require(described.folder, "the code of the teacher")
        source.check(None, None)
    return source


@dataclass(frozen=True)
class Teacher:
    """A policy in torch that fits the student's; ``edits`` were done to its structure."""

    bundle: Bundle
    edits: tuple[Edit, ...]
    program: BatchedProgram

    @classmethod
    def of(cls, student: Bundle, path: Path | None, modules: Mapping[str, nn.Module]) -> Teacher:
        """Open the teacher of a student.

        Args:
            path: the teacher's bundle, or its policy; what the student was before any edit when None.
            modules: the student's, which the teacher's must not share weights with.

        Raises:
            RecipeError: when it is exported, takes or gives something else, or is the student.
            SourceError: when its modules are the student's own.
        """
        bundle, edits = student, tuple[Edit, ...]()
        if path is not None:
            bundle = teacher_bundle(path)
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
    """Refuse a teacher that sees or does something else: both are given the same encoded observations and noise."""
    for ours, theirs, what in (
        (student.manifest.spec.inputs, teacher.manifest.spec.inputs, "is given"),
        (student.manifest.spec.outputs, teacher.manifest.spec.outputs, "gives"),
    ):
        wanted, other = ({tensor.name: tensor for tensor in tensors} for tensors in (ours, theirs))
        for name in sorted({*wanted, *other}):
            _check_same(what, name, _form(other.get(name)), _form(wanted.get(name)))
        for name, tensor in wanted.items():
            _check_units(name, (other[name], teacher), (tensor, student))
    drawn, given = (_noise(bundle) for bundle in (student, teacher))
    for name in drawn:
        _check_same("draws", name, given.get(name), drawn[name])


def _check_same(what: str, name: str, teacher: str | None, student: str | None) -> None:
    if teacher != student:
        raise RecipeError(
            f"The teacher {what} '{name}' as {teacher or 'nothing'}, the student as {student or 'nothing'}; they must "
            "agree.",
            "take a teacher with the same inputs and outputs",
        )


def _form(tensor: TensorSpec | None) -> str | None:
    if tensor is None:
        return None
    labels = f" of {', '.join(tensor.labels)}" if tensor.labels else ""
    return f"{tensor.kind} {list(tensor.shape)} {tensor.dtype}{labels}"


def _check_units(name: str, teacher: tuple[TensorSpec, Bundle], student: tuple[TensorSpec, Bundle]) -> None:
    """Refuse what has the same form, and means something else."""
    for what in (_unit, _statistics, _vocabulary, _image):
        if what(*teacher) != what(*student):
            raise RecipeError(
                f"The teacher and the student have another {(what.__doc__ or '').rstrip('.').lower()} for '{name}': "
                "what one of them is given, or gives, means something else to the other.",
                "take a teacher with the same units, statistics, tokenizer and image",
            )


def _unit(tensor: TensorSpec, _bundle: Bundle) -> Any:
    """Unit or mode."""
    return tensor.units(), tensor.mode


def _statistics(tensor: TensorSpec, bundle: Bundle) -> Any:
    """Normalisation."""
    normaliser = load_normaliser(tensor, bundle)
    return None if normaliser is None else (normaliser.offset.tolist(), normaliser.scale.tolist())


def _vocabulary(tensor: TensorSpec, bundle: Bundle) -> Any:
    """Vocabulary."""
    return bundle.manifest.files[f"{ASSETS}/{tensor.tokenizer}"].sha256 if tensor.tokenizer else ""


def _image(tensor: TensorSpec, _bundle: Bundle) -> Any:
    """Image."""
    return tensor.image


def _noise(bundle: Bundle) -> dict[str, str]:
    """Return what a program draws: name -> shape and distribution."""
    return {name: str(dict(wanted)) for step in bundle.manifest.program for name, wanted in step.noise.items()}
