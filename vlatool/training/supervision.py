"""The supervision of a training: shares of teacher and expert, as options and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import nn

NOISE_WORDS = (
    "a control, not for a robot (control noise): what the teacher said of an observation was given to another one"
)


@dataclass(frozen=True)
class Supervision:
    """Who says what is right.

    Args:
        alpha: share of the teacher's term in the loss; the rest is that of the expert's recorded actions.
        label_share: share of the recorded observations whose expert's actions are used.
        control: ``none``, or ``noise``: the teacher's labels are those of other observations.
    """

    alpha: float = 1.0
    label_share: float = 1.0
    control: str = "none"

    def loss_name(self, distance: str) -> str:
        """Return the name of the loss: of the distance from the teacher, and how much each term counts."""
        if self.alpha == 1:
            return distance
        return f"{self.alpha:g} {distance} + {1 - self.alpha:.4g} expert" if self.alpha else "expert"

    def about(self, looks: list[list[float]], labels: Mapping[str, int]) -> dict[str, Any]:
        """Return what a training says of its teacher, as JSON values.

        Args:
            looks: step, norm of the gradient of the teacher's term, and of the expert's, each with its share of the
                loss, wherever both were measured.
            labels: ``used`` and ``recorded`` observations with an expert's action; empty without an expert.

        Returns:
            ``alpha``, ``gradient_share`` (the teacher's norm in the sum of both, a mean over ``gradients``; None when
            none was measured), and where they apply ``gradients``, ``labels`` and ``control``.
        """
        gradients = [{"step": step, "teacher": ours, "expert": theirs, "share": ours / (ours + theirs)}
                     for step, ours, theirs in looks if ours + theirs > 0]  # fmt: skip
        measured = sum(look["share"] for look in gradients) / len(gradients) if gradients else None
        return {
            "alpha": self.alpha,
            "gradient_share": measured if 0 < self.alpha < 1 else self.alpha,
            **({"gradients": gradients} if gradients else {}),
            **({"labels": dict(labels)} if labels else {}),
            **({"control": self.control} if self.control != "none" else {}),
        }


TEACHER_ALONE = Supervision()


def parameters(modules: Mapping[str, nn.Module]) -> int:
    """Return how many numbers are trained in modules; those that several share count once."""
    return sum({id(value): value.numel() for module in modules.values() for value in module.parameters()}.values())


def teacher_lines(training: Mapping[str, Any]) -> tuple[str, ...]:
    """Say of a training how large the student is, and how much its teacher counted; a sentence each.

    Args:
        training: content of ``module/training.json``.
    """
    about = training["teacher"]
    control = (NOISE_WORDS,) if "control" in about else ()
    return (*control, size_line(training["parameters"]), f"gradient from the teacher: {_gradient(about)}")


def teacher_record(training: Mapping[str, Any]) -> dict[str, str]:
    """Return the same as a line of a table."""
    about = training["teacher"]
    size, control = size_line(training["parameters"]), {"control": NOISE_WORDS} if "control" in about else {}
    return {"student": size, "gradient from the teacher": _gradient(about), **control}


def size_line(parameters: Mapping[str, int]) -> str:
    """Say how large a student is beside its teacher.

    Example:
        >>> size_line({"student": 1_900_000, "teacher": 7_800_000})
        '1.9 M of 7.8 M parameters (24 %)'
        >>> size_line({"student": 166_204, "teacher": 237_000})
        '0.166 M of 0.237 M parameters (70 %)'
    """
    ours, theirs = parameters["student"], parameters["teacher"]
    return f"{_count(ours)} of {_count(theirs)} parameters ({100 * ours / max(1, theirs):.0f} %)"


def _count(number: int) -> str:
    millions = number / 1e6
    return f"{number:,}" if number < 1e5 else f"{millions:.3g} M" if millions < 1e3 else f"{millions:,.0f} M"


def _gradient(about: Mapping[str, Any]) -> str:
    """Return the teacher's share of the gradient, and why it is that."""
    alpha, looks = about["alpha"], about.get("gradients", ())
    if alpha == 1:
        return "100 % (alpha 1, the loss has no other term)"
    labels = about["labels"]
    known = f"{labels['used']:,} of {labels['recorded']:,} recorded observations with the expert's action"
    if alpha == 0:
        return f"0 % (alpha 0, the teacher was not asked; {known})"
    steps = ", ".join(f"{100 * look['share']:.0f} % in step {look['step']:,}" for look in looks)
    return f"{steps or 'not measured'} (alpha {alpha:g}; {known})"
