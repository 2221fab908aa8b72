"""A policy shaped like SmolVLA: a vision-language prefix and ten denoising steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.samples._entries import camera, instruction, numbers

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Two graphs shaped like SmolVLA: prefix (512x512 camera image, 48 instruction tokens, state of 32; 113 tokens "
    "through 16 layers) and 10 Euler steps of an action expert over a 50x32 chunk (float32); 450 M "
    "parameters as in the checkpoint, 394 M of which the graphs use."
)
SPEC: dict[str, object] = {
    "inputs": [camera(side=512), instruction(48), numbers("state", 32)],
    "outputs": [{**numbers("action", 50, 32), "mode": "absolute"}],
    "control_hz": 30,
    "chunk": 50,
}
PROGRAM: list[dict[str, object]] = [
    {
        "graph": "prefix",
        "feeds": {"image": "image", "ids": "instruction", "state": "state"},
        "gives": {"keys": "keys", "values": "values", "mask": "mask"},
    },
    {
        "graph": "step",
        "feeds": {"x": "x", "time": "time", "keys": "keys", "values": "values", "mask": "mask"},
        "gives": {"x_next": "action"},
        "repeat": 10,
        "carry": {"action": "x"},
        "schedule": {"time": [1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1]},
        "noise": {"x": {"shape": [1, 50, 32], "distribution": "normal"}},
    },
]
RANGES = {"state": (-1.0, 1.0)}
"""Inputs whose example values are uniform in a range; the others are standard normal."""


def make(seed: int = 0, device: str | None = None) -> dict[str, nn.Module]:
    """Return the policy in eval mode; the arguments are those of ``build``."""
    from vlatool.samples._build import build
    from vlatool.samples._smolvla import Prefix, SmolShape, Step

    shape = SmolShape()
    return {
        "prefix": build(lambda: Prefix(shape), seed, device=device, prefix="prefix"),
        "step": build(lambda: Step(shape), seed, device=device, prefix="step"),
    }
