"""Distillation: a policy is trained on what a teacher would do, without an expert."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.data import recordings_of
from vlatool.distill._student import DEPTH, student_steps
from vlatool.errors import DataError, RecipeError
from vlatool.stage.base import Chain
from vlatool.training.expert import RECORD, expert_loss
from vlatool.training.imitation import ImitationStage
from vlatool.training.supervision import Supervision

if TYPE_CHECKING:
    from torch import nn

    from vlatool.hardware.profile import Profile
    from vlatool.training.objective import Objective
    from vlatool.training.teacher import Teacher

OF_LABELS = ("l1", "l2", "huber")
"""Losses that compare continuous actions with those of an expert as they do with a teacher's."""


class PolicyDistillation(ImitationStage):
    """Train a policy to do what a teacher does, on recordings and, where it names an environment, on episodes.

    The teacher is the policy as it was before any edit, so that this recovers what pruning lost; or another bundle. No
    expert is needed: first the teacher acts, then repeatedly the student, and the teacher labels all states that they
    reach (DAgger: Ross et al., arXiv 1011.0686). With ``--student`` the policy is made smaller first, by
    ``prune depth`` and ``prune structured``.

    ``--alpha 0`` and ``--control noise`` are controls: training without the teacher's knowledge. Distillation must beat
    them, not the untrained student.
    """

    student: str = Field(
        "",
        description="make the student of SOURCE first: the share of the blocks of each stack and of the "
        "multiply-accumulates that stays, such as depth=0.5,width=0.75",
    )
    include: tuple[str, ...] = Field(
        (), description="globs of stacks that lose blocks by --student depth=...; the trunk's when empty"
    )
    exclude: tuple[str, ...] = Field((), description="globs of stacks that --student depth=... leaves as they are")
    alpha: float = Field(
        1.0,
        ge=0,
        le=1,
        description="share of the teacher in the loss; the rest compares with the expert's actions in the recording. "
        "0: no teacher and no episodes (a control)",
    )
    label_share: float = Field(
        1.0, gt=0, le=1, description="share of the recorded observations whose expert's actions are used"
    )
    control: Literal["none", "noise"] = Field(
        "none",
        description="noise: each observation gets the teacher's answer to another one, so that the student learns "
        "nothing from it; shows whether the teacher matters",
    )

    def chain(self) -> Chain:
        """Return the stages that make the student."""
        stacks = {name: globs for name, globs in (("include", self.include), ("exclude", self.exclude)) if globs}
        before = {name: options | (stacks if name == DEPTH else {}) for name, options in student_steps(self.student)}
        return Chain(before, options=("student", "include", "exclude"))

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """What the teacher and the expert are asked for fits together, and is there."""
        super().check(source, profile)
        self._check_stacks()
        if self.alpha == 1 and self.label_share < 1:
            raise RecipeError(
                "--label-share is of the expert's actions, and --alpha 1 uses none of them.",
                "give them a share of the loss, such as --alpha 0.5, or leave --label-share out",
            )
        if self.alpha == 0 and self.control != "none":
            raise RecipeError(
                f"--control {self.control} changes what the teacher says, and with --alpha 0 it is not asked.",
                "name one of both controls",
            )
        hints = [f"--{name}" for name, weight in self.hints().items() if weight]
        if hints and (self.alpha == 0 or self.control != "none"):
            other = "--alpha 0" if self.alpha == 0 else f"--control {self.control}"
            raise RecipeError(
                f"{' and '.join(hints)} would let the teacher say what it knows; {other} is a training without that.",
                "leave one of them out",
            )
        asked = [name for name in ("episodes", "student_episodes", "from_batches")
                 if getattr(self, name) and name in self.options()]  # fmt: skip
        if self.alpha == 0 and asked:
            raise RecipeError(
                "--alpha 0 learns from recorded actions alone: nobody is there who could say what is right "
                f"elsewhere; got --{asked[0].replace('_', '-')} {getattr(self, asked[0])}.",
                "leave it out",
            )
        if self.alpha < 1 and source is not None and recordings_of(source).calibration is None:
            raise DataError(
                f"--alpha {self.alpha:g} needs an expert's actions, and {source.path} has no recording.", RECORD
            )

    def _check_stacks(self) -> None:
        named = "--include" if self.include else "--exclude"
        if (self.include or self.exclude) and DEPTH not in dict(student_steps(self.student)):
            raise RecipeError(
                f"{named} names stacks of blocks, and the student loses none: --student is '{self.student}'.",
                "ask for fewer blocks, such as --student depth=0.5; weights are named to vlatool prune structured",
            )

    def supervision(self) -> Supervision:
        """Return who says what is right."""
        return Supervision(self.alpha, self.label_share, self.control)

    def prepare_objective(self, modules: Mapping[str, nn.Module], source: Bundle) -> tuple[Teacher, Objective]:
        """Return the teacher, and an objective in which the expert has its share."""
        teacher, objective = super().prepare_objective(modules, source)
        if self.alpha == 1:
            return teacher, objective
        distance = self._distance(self.loss if self.loss in OF_LABELS else "l1")
        return teacher, replace(objective, expert=expert_loss(modules, source, distance))
