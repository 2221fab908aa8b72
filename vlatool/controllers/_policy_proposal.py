"""A map proposed for a policy by the names, units and modes of its spec: for a person to check, not to run as it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.controllers._policy_map import ACTIONS, FRAMES, IMAGE, TEXT, kind_of
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.sensor_msgs import Image, JointState
from vlatool.messages.std_msgs import String
from vlatool.messages.trajectory_msgs import JointTrajectory

WORDS = {
    "linear.x": ("forward", "linear", "vx", "speed", "linear.x", "x"),
    "linear.y": ("sideways", "lateral", "strafe", "vy", "linear.y", "y"),
    "angular.z": ("turn", "angular", "yaw", "wz", "omega", "rotate", "angular.z", "theta"),
}
"""Path in a Twist -> words in the labels of actions that mean it."""
MOTIONS = {
    "forward": {"linear.x": 0.2}, "backward": {"linear.x": -0.2}, "back": {"linear.x": -0.2},
    "left": {"angular.z": 0.5}, "right": {"angular.z": -0.5},
}  # fmt: skip


def propose(spec: PolicySpec) -> dict[str, Any]:
    """Return a proposed map; see ``_policy_map``.

    Raises:
        UsageError: for an input that no topic can be.
    """
    cameras = [tensor.name for tensor in spec.inputs if kind_of(tensor) in (IMAGE, FRAMES)]
    return {
        "inputs": {tensor.name: _input(tensor, cameras) for tensor in spec.inputs},
        "output": _output(spec.action),
    }


def _input(tensor: TensorSpec, cameras: Sequence[str]) -> dict[str, Any]:
    kind = kind_of(tensor)
    if kind == TEXT:
        return {"topic": f"/{_word(tensor.name)}", "type": String.TYPE}
    if kind == ACTIONS:
        return {"source": "actions"}
    if kind in (IMAGE, FRAMES):
        camera = "camera/color" if len(cameras) == 1 else _word(tensor.name)
        return {"topic": f"/{camera}/image_raw", "type": Image.TYPE, "stale_s": 0.5}
    labels = tensor.labels or tuple(map(str, range(tensor.robot_width)))
    quantities = ["velocity" if unit.endswith("/s") else "position" for unit in tensor.units()]
    elements = {label: f"{label}.{quantity}" for label, quantity in zip(labels, quantities, strict=True)}
    return {"topic": "/joint_states", "type": JointState.TYPE, "stale_s": 0.5, "elements": elements}


def _output(action: TensorSpec) -> dict[str, Any]:
    if action.kind == "discrete":
        moves = {label: next((move for word, move in MOTIONS.items() if word in label.lower()), {})
                 for label in action.labels}  # fmt: skip
        return {"topic": "/cmd_vel", "type": Twist.TYPE, "labels": {name: dict(move) for name, move in moves.items()}}
    labels = action.labels or tuple(map(str, range(action.robot_width)))
    paths = [_path(label) for label in labels]
    if action.mode == "velocity" and all(paths) and len(set(paths)) == len(paths):
        return {"topic": "/cmd_vel", "type": Twist.TYPE, "elements": dict(zip(labels, paths, strict=True))}
    proposed = {"topic": "/joint_trajectory", "type": JointTrajectory.TYPE,
                "elements": {label: label for label in labels}}  # fmt: skip
    return proposed if action.mode in ("absolute", "delta", "velocity") else {**proposed, "mode": "absolute"}


def _path(label: str) -> str:
    plain = label.lower()
    return next((path for path, words in WORDS.items() if plain in words), "") or next(
        (path for path, words in WORDS.items() if any(word in plain for word in words if len(word) > 3)), ""
    )


def _word(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in name).strip("_") or "input"
