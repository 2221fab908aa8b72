"""One denoising pass of a flow-matching action expert."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.samples._entries import numbers

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Flow-matching action expert: one denoising pass over a 50x32 chunk with cross attention to 113 context tokens "
    "of width 960 (all float32), gives the flow's velocity; 127 M parameters, 12 layers of width 768."
)
SPEC: dict[str, object] = {
    "inputs": [numbers("actions", 50, 32), numbers("time"), numbers("context", 113, 960)],
    "outputs": [numbers("velocity", 50, 32)],
    "control_hz": 30,
    "chunk": 50,
}
RANGES = {"time": (0.1, 1.0)}
"""Inputs whose example values are uniform in a range; the others are standard normal."""


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode; the arguments are those of ``build``."""
    from vlatool.samples._build import build
    from vlatool.samples._expert import ActionExpert, ExpertShape

    return build(lambda: ActionExpert(ExpertShape()), seed, device=device)
