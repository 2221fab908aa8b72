"""Gradual magnitude pruning: zeros are added during training, so that the policy adapts to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.stage import ModuleChanges
from vlatool.prune._sparse_base import Pattern, check_pattern, describe_zeros, select_layers, smallest_mask
from vlatool.stage.base import Context
from vlatool.training.constraint import GrowingZeros
from vlatool.training.imitation import ImitationStage

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vlatool.hardware.profile import Profile
    from vlatool.training.objective import Objective
    from vlatool.training.teacher import Teacher


class Gradual(ImitationStage):
    """Set the smallest weights of each layer to zero step by step, while the policy learns from the teacher.

    After step t of n the share of zeros is ``s (1 - (1 - t/n)^3)`` (Zhu and Gupta, arXiv 1710.01878, from no zeros at
    the start): many early, when many weights are redundant, and few in the end. Zeros stay zero, and the rest of the
    training adds no more. The learning rate is lower than that of ``distill policy``: the student starts as the teacher
    itself, and larger steps would move it away before there is anything to learn. Shapes stay: CPUs multiply zeros like
    other numbers, so nothing is faster there; --pattern 2:4 is for sparse tensor cores.
    """

    changed_first: ClassVar[bool] = False
    leaves_zeros: ClassVar[bool] = True

    ratio: float = Field(0.5, gt=0, lt=1, description="share of each layer's weights that is zero in the end")
    pattern: Pattern = Field(
        "unstructured", description="2:4 is for sparse tensor cores (NVIDIA Ampere and later); it keeps half"
    )
    learning_rate: float = Field(
        1e-4, gt=0, le=1, description="peak learning rate, after warm-up and before cosine decay"
    )
    until: float = Field(0.6, gt=0, le=1, description="share of the steps during which weights are pruned")
    interval: int = Field(10, ge=1, description="training steps between two pruning steps")
    include: tuple[str, ...] = Field((), description="globs of layers; all but embeddings and heads when empty")
    exclude: tuple[str, ...] = Field((), description="globs of layers to leave as they are")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that the ratio fits the pattern, and that options fit gradual pruning."""
        super().check(source, profile)
        check_pattern(self.pattern, self.ratio)
        if self.shard:
            raise RecipeError(
                "--shard splits layers into parts, but the zeros of a layer are chosen over the whole layer.",
                "omit --shard",
            )
        if self.patience:
            raise RecipeError("--patience could choose weights from before the last zeros.", "omit --patience")

    def shares(self) -> dict[int, float]:
        """Return step that adds zeros -> share of zeros after it."""
        last = max(1, round(self.steps * self.until))
        numbers = [*range(self.interval, last, self.interval), last]
        return {number: self.ratio * (1 - (1 - number / last) ** 3) for number in numbers}

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Train, and report the layers that stay dense."""
        selection = select_layers(modules, source, self.include, self.exclude)
        return replace(super().change(modules, source, context), messages=selection.describe())

    def objective(self, modules: Mapping[str, nn.Module], source: Bundle, teacher: Teacher) -> Objective:
        """Return the objective: imitate the teacher with a growing share of zeros."""
        layers = select_layers(modules, source, self.include, self.exclude).prunable.values()
        zeros = GrowingZeros([layer.weight for layer in layers], self._pruned_mask, self.shares())
        return replace(super().objective(modules, source, teacher), constraint=zeros)

    def summarize(self, pruned: Bundle) -> tuple[str, ...]:
        """Report the share of zeros, and the training."""
        return (*describe_zeros(pruned, self.pattern), *super().summarize(pruned))

    def _pruned_mask(self, sizes: Tensor, share: float) -> Tensor:
        return smallest_mask(sizes, self.pattern, share, rows=False)
