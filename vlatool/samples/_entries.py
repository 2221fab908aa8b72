"""Inputs and outputs that several samples have, as a spec names them; needs no torch."""

from __future__ import annotations

Entry = dict[str, object]


def camera(name: str = "image", side: int = 224) -> Entry:
    """Return a raw camera image."""
    return {"name": name, "shape": [1, side, side, 3], "dtype": "uint8", "unit": "rgb"}


def instruction(tokens: int) -> Entry:
    """Return an instruction of words."""
    text = {"name": "instruction", "kind": "text", "shape": [1, tokens], "dtype": "int64"}
    return {**text, "tokenizer": "vocabulary.json", "max_tokens": tokens}


def numbers(name: str, *shape: int) -> Entry:
    """Return float32 numbers without a unit."""
    return {"name": name, "shape": [1, *shape], "dtype": "float32", "unit": "1"}


def arm_action(chunk: int) -> Entry:
    """Return the motions of an arm's hand, and of its gripper."""
    labels, units = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"], ["m"] * 3 + ["rad"] * 3 + ["1"]
    shape = {"name": "action", "shape": [1, chunk, 7], "dtype": "float32"}
    return {**shape, "labels": labels, "unit": units, "mode": "delta"}


def features() -> dict[str, object]:
    """Return the spec of a network that makes features of one camera image."""
    return {"inputs": [camera()], "outputs": [numbers("features", 1000)], "control_hz": 30, "chunk": 1}
