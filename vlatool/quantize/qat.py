"""Quantization-aware training: weights adapt to rounding before they are quantized."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from vlatool.data import MAX_PLAYED
from vlatool.runtime.engine import layouts
from vlatool.stage.base import Chain
from vlatool.stage.build import build_stage
from vlatool.training.fake_quantization import BLOCK, fake_quantization
from vlatool.training.imitation import ImitationStage

if TYPE_CHECKING:
    from vlatool.bundle.bundle import Bundle
    from vlatool.hardware.profile import Profile

    LayoutName = str
else:
    LayoutName = Literal[tuple(layouts())]


class Qat(ImitationStage):
    """Train a policy with rounded products, so that quantization afterwards costs less accuracy.

    The teacher is the policy in float32 before any edit, or ``--teacher``: no labels are needed. Weights are trained
    while rounded to the grid of ``quantize static-int8`` (int8, with activations) or ``quantize weight-only`` (int4, in
    blocks of 32). The command then quantizes them by that method: it writes a quantized bundle, and nothing else is
    left to do (a recipe names both stages). Ranges of activations come from the training, too: up to 128 observations,
    spread over its episodes, stay in the bundle (``data/played.npz``) and calibrate together with the recorded ones.
    Try the methods alone first: they take seconds, and most policies lose nothing.
    """

    changed_first: ClassVar[bool] = False
    keeps: ClassVar[int] = MAX_PLAYED

    weights: Literal["int8", "int4"] = Field("int8", description="int8 with int8 activations; int4 weights alone")
    learning_rate: float = Field(
        1e-4, gt=0, le=1, description="peak learning rate, after warm-up and before cosine decay"
    )
    layout: LayoutName = Field(
        "ort", description="layout of the bundle for the method that follows; that of --profile's board unless given"
    )

    def compute_context(self) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which products are rounded."""
        rounded: contextlib.AbstractContextManager[Any] = fake_quantization(self.weights)
        return rounded

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that the stages that follow take the layout."""
        for name, options in self.chain().after.items():
            build_stage(name, options)
        super().check(source, profile)

    def chain(self) -> Chain:
        """Return the stages that export and quantize to the trained grid, in the requested layout."""
        layout = {"layout": self.layout} if "layout" in self.model_fields_set else {}
        if self.weights == "int4":
            blocks = {"bits": 4, "block": BLOCK, "search": False}
            return Chain(after={"export.onnx": {}, "quantize.weight_only": {**blocks, **layout}})
        return Chain(after={"export.onnx": {}, "quantize.static_int8": layout})
