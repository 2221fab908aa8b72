"""ResNet-18 over one camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.samples._entries import features

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "ResNet-18 over one raw 224x224 camera image (uint8 NHWC) with a linear head to 1000 float32 features; "
    "11.7 M parameters, 1.8 G multiply-adds."
)
SPEC = features()


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode; the arguments are those of ``build``."""
    from vlatool.samples._build import build
    from vlatool.samples._convolution import ResNetFeatures

    return build(ResNetFeatures, seed, device=device)
