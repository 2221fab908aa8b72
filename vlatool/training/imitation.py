"""Training that brings a student's action close to its teacher's."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.batched_program import BatchedProgram
from vlatool.training.feature_distillation import with_hints
from vlatool.training.flow import CHUNK, check_loops, flow_loss
from vlatool.training.objective import Objective
from vlatool.training.rounds import LABEL
from vlatool.training.sequences import Unroll, outputs_and_labels
from vlatool.training.stage import TrainingStage

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vlatool.hardware.profile import Profile
    from vlatool.training.teacher import Teacher


class ImitationStage(TrainingStage):
    """Trains a student to do what its teacher does, from the same observation and the same noise."""

    loss: str = Field("auto", description="kl (discrete actions), l1, l2 or huber; kl or l1 when auto")
    temperature: float = Field(2.0, gt=0, le=100, description="temperature of the loss kl")
    delta: float = Field(0.1, gt=0, le=1000, description="threshold of the loss huber")
    targets: Literal["chunk", "flow"] = Field(
        "chunk",
        description="target of the loss: the action after all denoising steps, or one step for each observation, from "
        "the teacher's state (flow)",
    )
    features: float = Field(
        0.0, ge=0, le=1e6, description="weight of the loss between the outputs of blocks and the teacher's; 0 for none"
    )
    attention: float = Field(
        0.0, ge=0, le=1e6, description="weight of the loss between token similarities in block outputs; 0 for none"
    )

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The loss is known, and fits the action."""
        known = registry.names("losses")
        if self.loss != "auto" and self.loss not in known:
            raise RecipeError.unknown(f"Unknown loss '{self.loss}'", self.loss, ["auto", *known])
        super().check(source, profile)
        if source is not None and self.loss == "kl" and source.manifest.spec.action.kind != "discrete":
            raise RecipeError("The loss kl compares discrete actions; the policy's are continuous.", "try --loss l1")
        hints = [f"--{name}" for name, weight in self.hints().items() if weight]
        if self.targets == "flow" and hints:
            raise RecipeError(
                f"--targets flow runs single denoising steps, and {hints[0]} compares what blocks give in all of them.",
                "leave one of them out",
            )
        self._check_kept([name for step in source.manifest.program for name in step.keep] if source else [])
        if self.targets == "flow" and source is not None and source.manifest.spec.action.kind == "discrete":
            raise RecipeError("--targets flow compares continuous actions; the policy's are discrete.", CHUNK)

    def _check_kept(self, names: Sequence[str]) -> None:
        """Refuse what compares single observations, where a policy keeps values."""
        asked = [f"--{name}" for name, weight in self.hints().items() if weight]
        asked += ["--targets flow"] if self.targets == "flow" else []
        if names and asked:
            raise RecipeError(
                f"{asked[0]} compares single inferences, and the policy keeps '{names[0]}' from step to step.",
                f"leave {asked[0]} out: the actions are compared, along whole episodes",
            )

    def compute_context(self) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which the student computes."""
        return contextlib.nullcontext()

    def objective(self, modules: Mapping[str, nn.Module], source: Bundle, teacher: Teacher) -> Objective:
        """The student does with each observation what the teacher did."""
        action = source.manifest.spec.action
        name = self.loss if self.loss != "auto" else "kl" if action.kind == "discrete" else "l1"
        student, distance = BatchedProgram(source.manifest.program, modules), self._distance(name)

        def loss(rows: Mapping[str, Any]) -> Tensor:
            given, wanted = outputs_and_labels(student, rows, action.name, LABEL, self.compute_context)
            far: Tensor = distance(given.float(), wanted)
            return far

        self._check_kept([*student.kept, *teacher.program.kept])
        if self.targets == "flow":
            check_loops(student, teacher.program, action.name, source.manifest.name)
            turn = flow_loss(student, distance, self.compute_context)
            return Objective(f"flow {name}", modules, turn, judged=loss, turns=True)
        unroll = Unroll(self.window, self.burn_in) if student.kept else None
        base = Objective(name, modules, loss, unroll=unroll)
        return with_hints(base, self.hints(), student, source, teacher, self.seed)

    def hints(self) -> dict[str, float]:
        """Return the weight of each hint in the loss."""
        return {"features": self.features, "attention": self.attention}

    def _distance(self, name: str) -> Any:
        """Return the loss with the options that it takes."""
        kind = registry.load("losses", name)
        takes = inspect.signature(kind).parameters
        return kind(**{option: getattr(self, option) for option in ("temperature", "delta") if option in takes})
