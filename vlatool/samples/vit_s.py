"""ViT-S/16 over one camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.samples._entries import features

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "ViT-S/16 over one raw 224x224 camera image (uint8 NHWC) with a linear head to 1000 float32 features; "
    "22.1 M parameters, 197 tokens of width 384."
)
SPEC = features()


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode; the arguments are those of ``build``."""
    from vlatool.samples._build import build
    from vlatool.samples._vision import VIT_S, VisionFeatures

    return build(lambda: VisionFeatures(VIT_S), seed, device=device)
