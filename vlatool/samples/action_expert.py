"""One denoising pass of a flow-matching action expert."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Flow-matching action expert: one denoising pass over a 50x32 chunk with cross attention to 113 context tokens "
    "of width 960 (all float32), gives the flow's velocity; 127 M parameters, 12 layers of width 768."
)
SPEC: dict[str, object] = {
    "inputs": [
        {"name": "actions", "shape": [1, 50, 32], "dtype": "float32", "unit": "1"},
        {"name": "time", "shape": [1], "dtype": "float32", "unit": "1"},
        {"name": "context", "shape": [1, 113, 960], "dtype": "float32", "unit": "1"},
    ],
    "outputs": [
        {"name": "velocity", "shape": [1, 50, 32], "dtype": "float32", "unit": "1"},
    ],
    "control_hz": 30,
    "chunk": 50,
}
RANGES = {"time": (0.1, 1.0)}
"""Inputs whose example values are uniform in a range; the others are standard normal."""


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode.

    Args:
        seed: Seed of the weights.
        device: Where it lives, the CPU when None; ``"meta"`` costs no memory.
    """
    from vlatool.samples._build import build
    from vlatool.samples._expert import ActionExpert, ExpertShape

    return build(lambda: ActionExpert(ExpertShape()), seed, device=device)
