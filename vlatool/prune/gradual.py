"""Gradual magnitude pruning: zeros are added while the policy is trained, which learns to do without the weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.stage import ModuleChanges
from vlatool.prune._sparse import Pattern, check_pattern, least, sparse_layers, zeros_told
from vlatool.stage.base import Context
from vlatool.training.constraint import GrowingZeros
from vlatool.training.imitation import ImitationStage

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vlatool.hardware.profile import Profile
    from vlatool.training.objective import Objective
    from vlatool.training.teacher import Teacher


class Gradual(ImitationStage):
    """Set the smallest weights of each layer to zero step by step, while the teacher says what the policy should do.

    After step t of n the share of zeros is ``s (1 - (1 - t/n)^3)`` (Zhu and Gupta, arXiv 1710.01878, from no zeros at
    the start): many early, when there are many weights to spare, and few in the end. What is zero stays zero. The rest
    of the training goes on with the zeros as they are. The learning rate is lower than that of ``distill policy``: the
    student begins as the teacher itself, and larger steps move it away before there is anything to learn. Shapes stay:
    processors multiply zeros like other numbers, so that nothing is faster there; --pattern 2:4 is for sparse tensor
    cores.
    """

    changed_first: ClassVar[bool] = False
    leaves_zeros: ClassVar[bool] = True

    ratio: float = Field(0.5, gt=0, lt=1, description="share of each layer's weights that is zero in the end")
    pattern: Pattern = Field(
        "unstructured",
        description="2:4 is for sparse tensor cores (NVIDIA Ampere and later); it keeps half",
    )
    learning_rate: float = Field(1e-4, gt=0, le=1, description="its highest value; it warms up, and falls as a cosine")
    until: float = Field(0.6, gt=0, le=1, description="share of the steps after which no more weights become zero")
    interval: int = Field(10, ge=1, description="steps from one time that weights become zero to the next")
    include: tuple[str, ...] = Field((), description="globs of layers; all but embeddings and heads when empty")
    exclude: tuple[str, ...] = Field((), description="globs of layers to leave as they are")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The ratio is that of the pattern, and the last weights count."""
        super().check(source, profile)
        check_pattern(self.pattern, self.ratio)
        if self.shard:
            raise RecipeError(
                "--shard cuts layers into parts, and which of a layer's weights become zero is chosen in all of it.",
                "leave --shard out",
            )
        if self.patience:
            raise RecipeError(
                "--patience would choose weights from before the last ones became zero.", "leave --patience out"
            )

    def shares(self) -> dict[int, float]:
        """Return the number of each step that adds zeros -> the share of zeros after it."""
        last = max(1, round(self.steps * self.until))
        numbers = [*range(self.interval, last, self.interval), last]
        return {number: self.ratio * (1 - (1 - number / last) ** 3) for number in numbers}

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Train, and say which layers stay dense."""
        context.messages.extend(sparse_layers(modules, source, self.include, self.exclude).told())
        return super().change(modules, source, context)

    def objective(self, modules: Mapping[str, nn.Module], source: Bundle, teacher: Teacher) -> Objective:
        """The student does what the teacher does, with more and more zeros."""
        layers = sparse_layers(modules, source, self.include, self.exclude).chosen.values()
        zeros = GrowingZeros([layer.weight for layer in layers], self._goes, self.shares())
        return replace(super().objective(modules, source, teacher), constraint=zeros)

    def lines(self, made: Bundle) -> tuple[str, ...]:
        """Say how many weights are zero, and what was learnt."""
        return (*zeros_told(made, self.pattern), *super().lines(made))

    def _goes(self, sizes: Tensor, share: float) -> Tensor:
        return least(sizes, self.pattern, share, rows=False)
