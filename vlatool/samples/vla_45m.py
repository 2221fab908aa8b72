"""A small vision-language-action policy that gives a whole action chunk in one pass."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.samples._entries import arm_action, camera, instruction

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Vision-language-action policy: ViT-S/16 on 2 cameras of 224x224, 80 instruction tokens, 6 fusion layers of "
    "width 384, one 16x7 action chunk (float32) in one pass; 45 M parameters."
)
SPEC: dict[str, object] = {
    "inputs": [camera("image_front"), camera("image_wrist"), instruction(80)],
    "outputs": [arm_action(16)],
    "control_hz": 20,
    "chunk": 16,
}


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode; the arguments are those of ``build``."""
    from vlatool.samples._build import build
    from vlatool.samples._fusion import FusionPolicy, FusionShape

    return build(lambda: FusionPolicy(FusionShape()), seed, device=device)
